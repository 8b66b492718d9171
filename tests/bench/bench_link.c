/* Goodput of the link in virtual time on the emulated 3 Mbaud line: bytes of objects that arrived whole, against what
 * the line could have carried. CPU: both ends and the emulated line together, per byte on the wire. */
#include "pipefish/drivers/sim_line.h"
#include "pipefish/link.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define BAUD    3000000u
#define SECONDS 60u
#define TICK_NS 250000u /* a daemon that is woken four times a millisecond */

typedef struct bench {
    pf_sim_line *line;
    pf_link *ends[2]; /* crawler, host */
    uint64_t now, delivered, objects, previews, replies, answered;
    uint32_t order[PF_LINK_SLOTS_MAX], queued; /* objects that wait for "stored" */
} bench;

static uint8_t object[100000], preview[10000];

static void *allocate(size_t n)
{
    void *p = n == 0 ? NULL : aligned_alloc(16, (n + 15) / 16 * 16);
    if (p == NULL) {
        fprintf(stderr, "bench_link: out of memory\n");
        exit(1);
    }
    return p;
}

static pf_link *make_end(pf_link_role role)
{
    pf_link_config config = {.role = role, .nonce = 0x1234567u * role, .max_object = sizeof object};
    size_t n = pf_link_workspace_size(&config);
    pf_link *link = NULL;
    if (pf_link_init(&link, &config, allocate(n), n) != PF_OK)
        exit(1);
    return link;
}

static void feed(bench *b)
{
    while (pf_link_free_send_slots(b->ends[0]) > 0) {
        uint8_t name[PF_LINK_NAME_SIZE] = {0};
        memcpy(name, &b->objects, sizeof b->objects);
        uint32_t size = 75000 + (uint32_t)(b->objects * 2654435761u % 10000);
        if (pf_link_send_object(b->ends[0], name, PF_OBJECT_KEYFRAME, object, size) != PF_OK)
            exit(1);
        b->objects++;
    }
}

static void take_events(bench *b, uint32_t end)
{
    pf_link_event event;
    while (pf_link_next_event(b->ends[end], &event)) {
        if (event.type == PF_LINK_OFFER)
            pf_link_answer_object(b->ends[end], event.slot, PF_ANSWER_ACCEPT);
        if (event.type == PF_LINK_LATEST && event.topic == PF_TOPIC_PREVIEW)
            b->previews++;
        if (event.type == PF_LINK_CONTROL && end == 0) /* a status at its largest */
            (void)pf_link_send_control(b->ends[0], preview, 500);
        b->replies += event.type == PF_LINK_CONTROL && end == 1;
        if (event.type == PF_LINK_OBJECT) {
            b->delivered += event.size;
            pf_link_answer_object(b->ends[end], event.slot, PF_ANSWER_STORED);
        }
    }
}

static void step(bench *b, uint32_t end)
{
    uint8_t bytes[4096];
    size_t n = pf_sim_line_read(b->line, end, bytes, sizeof bytes, b->now);
    for (size_t done = 0; done < n;) {
        done += pf_link_input(b->ends[end], bytes + done, n - done, b->now);
        take_events(b, end);
    }
    size_t room = pf_sim_line_room(b->line, end, b->now);
    if (room >= PF_LINK_FRAME_MAX)
        pf_sim_line_write(b->line, end, bytes,
                          pf_link_output(b->ends[end], bytes, room < sizeof bytes ? room : sizeof bytes, b->now),
                          b->now);
    take_events(b, end);
}

/* Share of the line's capacity that arrived as objects. */
static double run(uint32_t loss_ppm, bool mixed, double *cpu_ns_per_byte)
{
    bench b = {0};
    pf_sim_line_config config = {
        .baud = BAUD, .fifo = 4096, .latency_ns = 1000000, .seed = 7, .faults = {.frame_loss_ppm = loss_ppm}};
    size_t n = pf_sim_line_workspace_size(&config);
    void *line = allocate(n);
    if (pf_sim_line_init(&b.line, &config, line, n) != PF_OK)
        exit(1);
    b.ends[0] = make_end(PF_LINK_DEVICE);
    b.ends[1] = make_end(PF_LINK_HOST);
    clock_t start = clock();
    for (b.now = 0; b.now < SECONDS * UINT64_C(1000000000); b.now += TICK_NS) {
        if (mixed && b.now % 500000000 == 0)
            pf_link_send_latest(b.ends[0], PF_TOPIC_PREVIEW, preview, sizeof preview);
        if (mixed && b.now % 200000000 == 0)
            pf_link_send_latest(b.ends[0], PF_TOPIC_STATUS, preview, 200);
        feed(&b);
        step(&b, 0);
        step(&b, 1);
    }
    const pf_link_stats *stats = pf_link_get_stats(b.ends[0]);
    *cpu_ns_per_byte =
        (double)(clock() - start) * (1e9 / CLOCKS_PER_SEC) / (double)(stats->bytes_in + stats->bytes_out);
    if (mixed && b.previews < 2 * SECONDS - 3) {
        fprintf(stderr, "bench_link: only %u previews arrived\n", (unsigned)b.previews);
        exit(1);
    }
    if (getenv("BENCH_LINK_VERBOSE") != NULL)
        fprintf(stderr, "sent %u resent %u duplicate %u rtt %u us\n", (unsigned)stats->fragments_sent,
                (unsigned)stats->fragments_resent, (unsigned)pf_link_get_stats(b.ends[1])->fragments_duplicate,
                stats->rtt_us);
    free(b.ends[0]);
    free(b.ends[1]);
    free(line);
    return (double)b.delivered / ((double)BAUD / 10 * SECONDS);
}

/* Longest time between a request and its reply, ms, while the device sends objects as fast as a slower line takes them.
 * In front of the reply wait one fragment, and what the operating system holds of 5 ms (transport.h, room). */
static double run_control(void)
{
    const uint32_t baud = 921600;
    bench b = {0};
    pf_sim_line_config config = {
        .baud = baud, .fifo = PF_LINK_FRAME_MAX + baud / 10 / 200, .latency_ns = 1000000, .seed = 8};
    size_t n = pf_sim_line_workspace_size(&config);
    void *line = allocate(n);
    uint64_t asked = 0, most = 0;
    if (pf_sim_line_init(&b.line, &config, line, n) != PF_OK)
        exit(1);
    b.ends[0] = make_end(PF_LINK_DEVICE);
    b.ends[1] = make_end(PF_LINK_HOST);
    for (b.now = 0; b.now < SECONDS * UINT64_C(1000000000); b.now += TICK_NS) {
        if (asked == 0 && b.now > UINT64_C(1000000000) && b.now % 70000000 == 0 &&
            pf_link_send_control(b.ends[1], preview, 32) == PF_OK)
            asked = b.now;
        feed(&b);
        step(&b, 0);
        step(&b, 1);
        if (asked != 0 && b.replies > 0) {
            most = b.now - asked > most ? b.now - asked : most;
            asked = b.replies = 0;
            b.answered++;
        }
    }
    if (b.answered < 500) {
        fprintf(stderr, "bench_link: only %u replies\n", (unsigned)b.answered);
        exit(1);
    }
    free(b.ends[0]);
    free(b.ends[1]);
    free(line);
    return (double)most / 1e6;
}

static void print_ratio(const char *name, double value)
{
    printf("{\"name\": \"%s\", \"value\": %.4f, \"unit\": \"ratio\", \"peer\": \"line rate\", \"peer_value\": 1.0}\n",
           name, value);
}

int main(void)
{
    uint64_t random = 1;
    for (size_t i = 0; i < sizeof object; i++) {
        random = random * UINT64_C(6364136223846793005) + 1442695040888963407u;
        object[i] = (uint8_t)(random >> 56);
    }
    memcpy(preview, object, sizeof preview);
    double cpu, other;
    print_ratio("link.goodput_clean", run(0, false, &cpu));
    print_ratio("link.goodput_1pct", run(10000, false, &other));
    print_ratio("link.goodput_mixed", run(0, true, &other));
    printf("{\"name\": \"link.control_rtt_most\", \"value\": %.2f, \"unit\": \"ms\"}\n", run_control());
    printf("{\"name\": \"link.cpu_ns_per_byte\", \"value\": %.2f, \"unit\": \"ns/byte\"}\n", cpu);
    return 0;
}
