/* One end of a link against a peer that says anything: the input is a list of frames whose session tag, checksum and
 * COBS code are put right here (without that a fuzzer never gets past the checksum), of raw bytes, and of what the
 * caller does in between.
 * Invariants: an object is handed over only with the size that was offered and accepted, after as many fragments as it
 * has, and each of them in its place; so is a message of several; questions are asked once; events are well formed;
 * what we lent to the link is not written; a deadline that has come has a frame or an event behind it; what we send are
 * whole frames with their checksums. The workspace has its exact size, so that AddressSanitizer guards its end. */
#include "pipefish/link.h"

#include <stdlib.h>
#include <string.h>

/* Small fragments: what a frame does costs more time than its bytes, and what depends on their number is in reach. */
enum { FRAGMENT = 256, MAX_OBJECT = 1250, MAX_LATEST = 750, SLOTS = 3, NONCE = 0x01020304, PEER = 0x0A0B0C0D };

#define REQUIRE(condition)                                                                                             \
    do {                                                                                                               \
        if (!(condition))                                                                                              \
            abort();                                                                                                   \
    } while (0)

typedef struct fuzz {
    pf_link *link;
    uint64_t now;
    uint32_t open[SLOTS]; /* 0, PF_LINK_OFFER or PF_LINK_OBJECT */
    uint32_t size[SLOTS];
    uint32_t lent; /* objects under way */
    uint32_t tx, offered[4], latest;
    uint32_t nonce, peer; /* of the session */
    uint8_t ping[12];     /* number and time of the link's last one */
    bool is_narrow;       /* the line takes few bytes at once */
    bool is_strange;      /* bytes have come of which nothing is known: contents are not looked at any more */
} fuzz;

static uint8_t object[4000], lent[sizeof object];
static volatile uint8_t sink;

static void put32(uint8_t *p, uint32_t v)
{
    for (int i = 0; i < 4; i++)
        p[i] = (uint8_t)(v >> 8 * i);
}

/* What feed_likely and feed_beside put into fragments. */
static uint8_t object_byte(uint32_t fragment)
{
    return (uint8_t)(0xA0 + fragment);
}

static void check_contents(const fuzz *f, const pf_link_event *e)
{
    for (uint32_t i = 0; i < e->size && !f->is_strange; i++)
        REQUIRE(e->data[i] == (e->type == PF_LINK_OBJECT ? object_byte(i / FRAGMENT) : e->data[0]));
}

static void check_event(fuzz *f, const pf_link_event *e)
{
    REQUIRE(e->type >= PF_LINK_UP && e->type <= PF_LINK_REFUSED);
    REQUIRE(e->topic < PF_LINK_TOPICS);
    if (e->data != NULL && e->size > 0) /* readable from end to end */
        for (uint32_t i = 0; i < e->size; i++)
            sink = e->data[i];
    switch (e->type) {
    case PF_LINK_UP:
        f->peer = e->peer_nonce;
        break;
    case PF_LINK_CONTROL:
        REQUIRE(e->data != NULL && e->size <= PF_LINK_FRAME_MAX);
        break;
    case PF_LINK_LATEST:
        REQUIRE(e->data != NULL && e->size <= MAX_LATEST);
        check_contents(f, e);
        break;
    case PF_LINK_OFFER:
        REQUIRE(e->slot < SLOTS && f->open[e->slot] == 0 && e->size > 0 && e->size <= MAX_OBJECT);
        f->open[e->slot] = PF_LINK_OFFER;
        f->size[e->slot] = e->size;
        break;
    case PF_LINK_OBJECT:
        REQUIRE(e->slot < SLOTS && f->open[e->slot] == 0 && e->size == f->size[e->slot] && e->data != NULL);
        REQUIRE(pf_link_get_stats(f->link)->fragments_received >= (e->size + 1023) / 1024);
        f->open[e->slot] = PF_LINK_OBJECT;
        check_contents(f, e);
        break;
    case PF_LINK_SENT:
    case PF_LINK_REFUSED:
        REQUIRE(f->lent > 0);
        f->lent--;
        break;
    default:
        break;
    }
}

static void take_events(fuzz *f)
{
    pf_link_event event;
    while (pf_link_next_event(f->link, &event))
        check_event(f, &event);
}

static void feed(fuzz *f, const uint8_t *bytes, size_t n)
{
    for (size_t done = 0; done < n;) {
        done += pf_link_input(f->link, bytes + done, n - done, f->now);
        take_events(f);
    }
}

static void feed_frame(fuzz *f, uint8_t type, const uint8_t *body, size_t n)
{
    uint8_t frame[1100] = {(uint8_t)(type < 0xF0 ? 0x10 | (type & 15) : type), 0}, code[1120];
    uint32_t tag = (f->peer ^ f->nonce >> 16) & 0xFFFF;
    frame[2] = (uint8_t)tag;
    frame[3] = (uint8_t)(tag >> 8);
    memcpy(frame + 4, body, n);
    put32(frame + 4 + n, pf_crc32c(0, frame, 4 + n));
    size_t size = pf_cobs_encode(frame, n + 8, code);
    code[size++] = 0;
    feed(f, code, size);
}

static void say_hello(fuzz *f)
{
    uint8_t body[32] = {PF_LINK_HOST, 1, 2, 1};
    put32(body + 4, f->peer);
    put32(body + 8, f->nonce);
    body[21] = FRAGMENT >> 8;
    feed_frame(f, 0, body, sizeof body);
}

static uint32_t get32(const uint8_t *p)
{
    return p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

/* What the link sends: whole frames. Its last ping is kept, for the answer. */
static void check_output(fuzz *f, const uint8_t *bytes, size_t n)
{
    uint8_t frame[PF_LINK_FRAME_MAX];
    for (size_t begin = 0, i = 0; i < n; i++) {
        size_t size = 0;
        if (bytes[i] != 0)
            continue;
        if (i > begin) {
            REQUIRE(i - begin < sizeof frame && pf_cobs_decode(bytes + begin, i - begin, frame, &size) == PF_OK);
            REQUIRE(size >= 8 && pf_crc32c(0, frame, size - 4) == get32(frame + size - 4) && frame[0] >> 4 == 1);
            if ((frame[0] & 15) == 7)
                memcpy(f->ping, frame + 4, sizeof f->ping);
        }
        begin = i + 1;
    }
}

static void talk(fuzz *f)
{
    static uint8_t out[4096];
    bool due = pf_link_deadline(f->link, f->now) <= f->now;
    size_t n = pf_link_output(f->link, out, f->is_narrow ? 1200 : sizeof out, f->now);
    pf_link_event event;
    bool any = pf_link_next_event(f->link, &event);
    REQUIRE(n <= sizeof out && (n == 0 || out[n - 1] == 0));
    REQUIRE(due == (n > 0 || any));
    check_output(f, out, n);
    if (any)
        check_event(f, &event);
    take_events(f);
}

static void act(fuzz *f, uint8_t what)
{
    uint8_t name[PF_LINK_NAME_SIZE] = {(uint8_t)(what >> 4)};
    uint32_t slot = (what >> 4) % SLOTS, answer = 1 + (uint32_t)(what >> 6);
    switch (what & 7) {
    case 0:
        f->now += (uint64_t)(what >> 3) * 40000000;
        break;
    case 1:
    case 2:
        if (pf_link_answer_object(f->link, slot, (pf_link_answer)answer) == PF_OK) {
            REQUIRE(f->open[slot] != 0);
            f->open[slot] = 0;
        }
        break;
    case 3:
        f->lent += pf_link_send_object(f->link, name, 2, object, 1 + (size_t)(what >> 3) * 100) == PF_OK;
        break;
    case 4:
        f->lent -= pf_link_cancel_object(f->link, name) == PF_OK;
        break;
    case 5:
        pf_link_send_control(f->link, object, what);
        pf_link_send_latest(f->link, slot, object, (size_t)what * 10);
        break;
    case 6:
        if (what >> 3 & 1) {
            f->nonce++;
            pf_link_renew(f->link, f->nonce, f->now);
        } else {
            pf_link_reset(f->link, f->now);
        }
        say_hello(f);
        break;
    default:
        f->is_narrow = what >> 3 & 1;
        say_hello(f);
        break;
    }
}

/* A frame of bulk that is nearly right, so that the fuzzer finds the way to a whole object and to an acknowledged one.
 */
static void feed_likely(fuzz *f, uint8_t op, uint8_t choice)
{
    static const uint32_t sizes[8] = {1, 64, FRAGMENT, FRAGMENT + 1, 750, MAX_OBJECT, MAX_OBJECT + 1, 0};
    uint8_t body[8 + FRAGMENT] = {(uint8_t)(1 + choice % 4)};
    uint32_t handle = choice % 4, index = choice / 4 % 8;
    switch (op % 4) {
    case 0: /* OFFER */
        f->offered[handle] = sizes[index];
        body[2] = 2;
        put32(body + 4, sizes[index]);
        body[9] = FRAGMENT >> 8;
        memset(body + 12, choice / 4, PF_LINK_NAME_SIZE);
        feed_frame(f, 4, body, 44);
        break;
    case 1: { /* DATA */
        uint32_t rest = f->offered[handle] > index * FRAGMENT ? f->offered[handle] - index * FRAGMENT : 1;
        body[2] = (uint8_t)index;
        put32(body + 4, f->tx += 1 + op / 16 % 2);
        memset(body + 8, object_byte(index), sizeof body - 8);
        feed_frame(f, 5, body, 8 + (rest < FRAGMENT ? rest : FRAGMENT));
        break;
    }
    default: /* ACK */
        body[2] = op / 4 % 8;
        put32(body + 4, choice / 16);
        body[8] = (uint8_t)index;
        body[10] = choice;
        feed_frame(f, 6, body, 10 + op % 2);
        break;
    }
}

/* Likely too, beside bulk: hellos of this peer, of the next and of the last one, latest messages, answers to pings. */
static void feed_beside(fuzz *f, uint8_t op, uint8_t choice)
{
    static const uint32_t sizes[8] = {0, 1, 64, 65, FRAGMENT, FRAGMENT + 1, MAX_LATEST, MAX_LATEST + 1};
    uint8_t body[12 + FRAGMENT] = {0};
    switch (op % 4) {
    case 0: /* HELLO */
        body[0] = choice & 1 ? PF_LINK_DEVICE : PF_LINK_HOST;
        body[1] = body[2] = 1;
        body[3] = choice >> 1 & 1;
        put32(body + 4, f->peer + choice / 4 % 4 - 1);
        put32(body + 8, choice & 16 ? f->nonce : choice);
        body[12] = choice / 32 % 2;
        put32(body + 20, choice & 64 ? 64 : FRAGMENT);
        feed_frame(f, choice & 128 ? 0xF0 : 0, body, 32);
        break;
    case 1: { /* PONG */
        memcpy(body, f->ping, sizeof f->ping);
        body[choice % 16] ^= (uint8_t)(choice >> 4 & 1);
        body[13] = choice;
        feed_frame(f, 8, body, 20);
        break;
    }
    default: { /* LATEST */
        uint32_t size = sizes[choice / 4 % 8], index = choice / 32 % 4;
        uint32_t rest = size > index * FRAGMENT ? size - index * FRAGMENT : 0;
        f->latest += op / 4 % 4;
        body[0] = choice % 4;
        body[2] = (uint8_t)index;
        put32(body + 4, f->latest);
        put32(body + 8, size);
        memset(body + 12, (int)(f->latest & 0xFF), sizeof body - 12);
        feed_frame(f, 3, body, 12 + (rest < FRAGMENT ? rest : FRAGMENT));
        break;
    }
    }
}

/* Records: 0xxxxxxx act; 10tttttt l: a frame of type t with a body of l bytes; 110xxxxx c and 1110xxxx c: a likely
 * frame; else: raw bytes. */
static size_t take_record(fuzz *f, const uint8_t *data, size_t n)
{
    uint8_t op = data[0];
    if (op < 0x80) {
        act(f, op);
        return 1;
    }
    if (n < 2)
        return n;
    if (op >= 0xC0 && op < 0xE0) {
        feed_likely(f, op, data[1]);
        return 2;
    }
    if (op >= 0xE0 && op < 0xF0) {
        feed_beside(f, op, data[1]);
        return 2;
    }
    size_t length = data[1] < n - 2 ? data[1] : n - 2;
    uint8_t type = (op & 0x3F) < 0x3E ? op & 15 : 0xF0;
    f->is_strange = f->is_strange || op >= 0xC0 || (type >= 3 && type <= 5);
    if (op < 0xC0)
        feed_frame(f, type, data + 2, length);
    else
        feed(f, data + 2, length);
    return 2 + length;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    pf_link_config config = {.role = PF_LINK_DEVICE,
                             .nonce = NONCE,
                             .receive_slots = SLOTS,
                             .max_object = MAX_OBJECT,
                             .max_latest = MAX_LATEST,
                             .window = 4096};
    size_t size = pf_link_workspace_size(&config);
    void *workspace = malloc(size);
    fuzz f = {.now = 1000000000, .nonce = NONCE, .peer = PEER};
    memset(lent, 0xEE, sizeof lent);
    memcpy(object, lent, sizeof object);
    REQUIRE(workspace != NULL && pf_link_init(&f.link, &config, workspace, size) == PF_OK);
    say_hello(&f);
    while (n > 0) {
        size_t used = take_record(&f, data, n);
        data += used;
        n -= used;
        talk(&f);
    }
    REQUIRE(memcmp(object, lent, sizeof object) == 0);
    free(workspace);
    return 0;
}
