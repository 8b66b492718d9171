// SPDX-License-Identifier: GPL-2.0
/* Gives the virtual USB controller of USB/IP a node of the device tree, as every real controller of a board has one:
 * libcamera 0.0.3 names USB cameras by it and takes none without. The node is that of the board's PCIe bridge, on which
 * QEMU's USB controllers sit. */
#include <linux/module.h>
#include <linux/of.h>
#include <linux/platform_device.h>

static struct device *controller;

static int __init vhci_node_begin(void)
{
    struct device_node *node;
    int error = -ENODEV;
    controller = bus_find_device_by_name(&platform_bus_type, NULL, "vhci_hcd.0");
    node = of_find_node_by_path("/pcie@10000000");
    if (controller && node)
        error = sysfs_create_link(&controller->kobj, of_node_kobj(node), "of_node");
    of_node_put(node);
    if (error)
        put_device(controller);
    return error;
}

static void __exit vhci_node_end(void)
{
    sysfs_remove_link(&controller->kobj, "of_node");
    put_device(controller);
}

module_init(vhci_node_begin);
module_exit(vhci_node_end);
MODULE_DESCRIPTION("Firmware node for vhci_hcd");
MODULE_LICENSE("GPL");
