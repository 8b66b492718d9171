/* One line an event on standard error, with the level that journald understands: "<6>pipefishd: text". */
#ifndef PIPEFISHD_LOG_H
#define PIPEFISHD_LOG_H

#include <stdint.h>

/* Lines of a level above this (pf_config's PF_LOG_...) are left out. */
void pf_log_set_level(uint32_t level);

__attribute__((format(printf, 2, 3))) void pf_log(uint32_t level, const char *format, ...);

#endif
