/* CRC, COBS, and two ends of a link that meet, talk and move an object: every byte on the wire. */
#include "pipefish/link.h"
#include "hashes.h"

#include <string.h>

enum { OBJECT = 3000 };

static _Alignas(16) uint8_t block[2][40000];
static uint8_t object[OBJECT], line[PF_LINK_FRAME_MAX * 2];

static uint32_t take_events(uint32_t crc, pf_link *link)
{
    pf_link_event event;
    while (pf_link_next_event(link, &event)) {
        crc = hash_u32(hash_u32(crc, event.type), event.size);
        if (event.type == PF_LINK_CONTROL || event.type == PF_LINK_LATEST || event.type == PF_LINK_OBJECT)
            crc = pf_crc32c(crc, event.data, event.size);
        if (event.type == PF_LINK_OFFER)
            (void)pf_link_answer_object(link, event.slot, PF_ANSWER_ACCEPT);
        if (event.type == PF_LINK_OBJECT)
            (void)pf_link_answer_object(link, event.slot, PF_ANSWER_STORED);
    }
    return crc;
}

uint32_t hash_link(size_t *ram)
{
    const pf_link_config config[2] = {
        {.role = PF_LINK_DEVICE, .nonce = 5, .boot_id = 77, .max_fragment = 256, .max_latest = 256, .send_slots = 1},
        {.role = PF_LINK_HOST,
         .nonce = 9,
         .max_fragment = 256,
         .max_latest = 256,
         .receive_slots = 1,
         .max_object = OBJECT}};
    pf_link *end[2];
    uint32_t crc = 0, state = 4;
    const uint8_t name[PF_LINK_NAME_SIZE] = {1, 2, 3};
    for (int i = 0; i < OBJECT; i++)
        object[i] = (uint8_t)(hash_random(&state) % 5u);
    for (int i = 0; i < 2; i++)
        if (pf_link_init(&end[i], &config[i], block[i], sizeof block[i]) != PF_OK)
            return 0;
    *ram = pf_link_workspace_size(&config[0]);
    for (uint64_t step = 0; step < 400; step++) {
        const uint64_t now = (step + 1) * 5000000u;
        pf_link *from = end[step % 2u], *to = end[1 - step % 2u];
        if (step == 40)
            crc = hash_u32(crc, (uint32_t)pf_link_send_object(end[0], name, PF_OBJECT_KEYFRAME, object, OBJECT));
        if (step == 44)
            crc = hash_u32(crc, (uint32_t)pf_link_send_control(end[1], object, 100));
        if (step == 48)
            crc = hash_u32(crc, (uint32_t)pf_link_send_latest(end[0], PF_TOPIC_STATUS, object + 7, 200));
        size_t n = pf_link_output(from, line, sizeof line, now);
        crc = pf_crc32c(crc, line, n);
        if (n > 20 && step % 17u == 3) /* a damaged byte now and then */
            line[n / 2] ^= 0x40;
        for (size_t done = 0; done < n;) {
            done += pf_link_input(to, line + done, n - done, now);
            crc = take_events(crc, to);
        }
        crc = take_events(crc, from);
    }
    return pf_link_get_stats(end[1])->objects_received == 1 ? crc : 0;
}
