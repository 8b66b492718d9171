#include "link_world.h"
#include "unity.h"

#include <string.h>

static _Alignas(16) uint8_t workspaces[2][WORLD_WORKSPACE], line_workspace[8000000];
static uint8_t contents[2][WORLD_OBJECTS][WORLD_OBJECT_SIZE];

uint8_t world_byte(uint32_t end, uint32_t id, uint32_t i)
{
    uint32_t x = (i + 1) * 2654435761u ^ id * 40503u ^ end * 977u;
    x ^= x >> 15;
    return i % 37 < 5 ? 0 : (uint8_t)(x * 2246822519u >> 24); /* some runs of zeros for COBS */
}

uint64_t world_random(world *w, uint64_t below)
{
    uint64_t z = w->random += UINT64_C(0x9E3779B97F4A7C15);
    z = (z ^ z >> 30) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ z >> 27) * UINT64_C(0x94D049BB133111EB);
    return (z ^ z >> 31) % below;
}

static void start(world *w, uint32_t end)
{
    world_app *app = &w->apps[end];
    app->start++;
    app->config.nonce = 0x10000u * app->start * 7u + 0x101u * app->start + end + 1;
    size_t n = pf_link_workspace_size(&app->config);
    TEST_ASSERT_TRUE(n > 0 && n <= WORLD_WORKSPACE);
    memset(workspaces[end], 0xA5, n); /* init must not rely on zeros */
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_init(&app->link, &app->config, workspaces[end], n));
    memset(app->given, 0, sizeof app->given);
    memset(app->questions, 0, sizeof app->questions);
}

void world_init(world *w, const pf_sim_line_config *line, const pf_link_config configs[2])
{
    memset(w, 0, sizeof *w);
    w->random = line->seed;
    w->now = 1000 * WORLD_MS;
    size_t n = pf_sim_line_workspace_size(line);
    TEST_ASSERT_TRUE(n > 0 && n <= sizeof line_workspace);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_sim_line_init(&w->line, line, line_workspace, n));
    for (uint32_t end = 0; end < 2; end++) {
        w->apps[end].config = configs[end];
        for (uint32_t id = 0; id < WORLD_OBJECTS; id++)
            for (uint32_t i = 0; i < WORLD_OBJECT_SIZE; i++)
                contents[end][id][i] = world_byte(end, id, i);
        start(w, end);
    }
}

void world_restart(world *w, uint32_t end)
{
    start(w, end);
}

static void make_name(uint8_t *name, uint32_t end, uint32_t id)
{
    memset(name, 0x5A, PF_LINK_NAME_SIZE);
    name[0] = (uint8_t)end;
    name[31] = (uint8_t)id;
}

static uint32_t name_id(const uint8_t *name, uint32_t sender)
{
    uint8_t expected[PF_LINK_NAME_SIZE];
    make_name(expected, sender, name[31]);
    TEST_ASSERT_EQUAL_MEMORY(expected, name, PF_LINK_NAME_SIZE);
    TEST_ASSERT_TRUE(name[31] < WORLD_OBJECTS);
    return name[31];
}

/* ---- what an application does with each event ---- */

static void ask(world *w, uint32_t end, const pf_link_event *event, bool object)
{
    world_app *app = &w->apps[end];
    uint32_t id = name_id(event->name, !end);
    TEST_ASSERT_TRUE(event->slot < PF_LINK_SLOTS_MAX);
    TEST_ASSERT_FALSE_MESSAGE(app->questions[event->slot].open, "asked twice");
    TEST_ASSERT_EQUAL_UINT32(w->apps[!end].sizes[id], event->size);
    TEST_ASSERT_EQUAL_UINT32(PF_OBJECT_KEYFRAME, event->kind);
    pf_link_answer answer = object ? PF_ANSWER_STORED : app->stored[id] ? PF_ANSWER_STORED : PF_ANSWER_ACCEPT;
    if (!object && (app->refuse_mask >> id & 1u) != 0)
        answer = PF_ANSWER_REFUSE;
    if (object && app->again_left > 0 && world_random(w, 2) == 0) {
        app->again_left--;
        answer = PF_ANSWER_AGAIN;
    }
    if (object) {
        TEST_ASSERT_FALSE_MESSAGE(app->stored[id], "arrived twice");
        TEST_ASSERT_EQUAL_MEMORY(contents[!end][id], event->data, event->size);
        app->stored[id] = answer == PF_ANSWER_STORED;
    }
    app->questions[event->slot].open = true;
    app->questions[event->slot].slot = event->slot;
    app->questions[event->slot].answer = answer;
    app->questions[event->slot].id = id;
    app->questions[event->slot].object = object;
    app->questions[event->slot].at = w->now + (app->answer_delay > 0 ? world_random(w, app->answer_delay) : 0);
}

static uint32_t get32(const uint8_t *p)
{
    return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static void put32(uint8_t *p, uint32_t v)
{
    for (int i = 0; i < 4; i++)
        p[i] = (uint8_t)(v >> 8 * i);
}

static void hear_control(world *w, uint32_t end, const pf_link_event *event)
{
    world_app *app = &w->apps[end];
    TEST_ASSERT_TRUE(event->size >= 8);
    uint32_t from = get32(event->data), number = get32(event->data + 4);
    TEST_ASSERT_TRUE_MESSAGE(from >= app->control_start && from <= w->apps[!end].start, "control of an earlier start");
    if (from != app->control_start) {
        app->control_start = from;
        app->control_seen = 0;
    }
    TEST_ASSERT_TRUE_MESSAGE(number >= app->control_seen, "control twice or out of order");
    if (w->lossless)
        TEST_ASSERT_EQUAL_UINT32_MESSAGE(app->control_seen, number, "control message missing");
    uint64_t wait = w->now - w->control_sent_at[!end][number % 256];
    app->worst_control_wait = wait > app->worst_control_wait ? wait : app->worst_control_wait;
    app->control_seen = number + 1;
    app->control_count++;
    for (uint32_t i = 8; i < event->size; i++)
        TEST_ASSERT_EQUAL_HEX8((uint8_t)(number + i), event->data[i]);
}

static void hear_latest(world *w, uint32_t end, const pf_link_event *event)
{
    world_app *app = &w->apps[end];
    TEST_ASSERT_TRUE(event->topic < PF_LINK_TOPICS && event->size >= 8);
    uint32_t from = get32(event->data), number = get32(event->data + 4);
    TEST_ASSERT_TRUE_MESSAGE(from >= app->latest_start && from <= w->apps[!end].start, "latest of an earlier start");
    if (from != app->latest_start) {
        app->latest_start = from;
        memset(app->latest_seen, 0, sizeof app->latest_seen);
    }
    TEST_ASSERT_TRUE_MESSAGE(number >= app->latest_seen[event->topic], "an older message after a newer one");
    app->latest_seen[event->topic] = number + 1;
    app->latest_count++;
    for (uint32_t i = 8; i < event->size; i++)
        TEST_ASSERT_EQUAL_HEX8((uint8_t)(number * 3 + i), event->data[i]);
}

static void take_events(world *w, uint32_t end)
{
    world_app *app = &w->apps[end];
    pf_link_event event;
    while (pf_link_next_event(app->link, &event)) {
        switch (event.type) {
        case PF_LINK_UP:
            app->ups++;
            TEST_ASSERT_EQUAL_HEX32(w->apps[!end].config.role, event.peer_role);
            break;
        case PF_LINK_DOWN:
            app->downs++;
            break;
        case PF_LINK_CONTROL:
            hear_control(w, end, &event);
            break;
        case PF_LINK_LATEST:
            hear_latest(w, end, &event);
            break;
        case PF_LINK_OFFER:
            app->offers++;
            ask(w, end, &event, false);
            break;
        case PF_LINK_OBJECT:
            ask(w, end, &event, true);
            break;
        case PF_LINK_SENT: {
            uint32_t id = name_id(event.name, end);
            TEST_ASSERT_TRUE_MESSAGE(w->apps[!end].stored[id], "released before it was stored");
            TEST_ASSERT_FALSE_MESSAGE(app->sent[id], "released twice");
            app->sent[id] = true;
            break;
        }
        case PF_LINK_REFUSED:
            app->refused[name_id(event.name, end)] = true;
            break;
        default:
            TEST_FAIL_MESSAGE("unknown event");
        }
    }
}

/* ---- what it does by itself ---- */

static void say_things(world *w, uint32_t end)
{
    world_app *app = &w->apps[end];
    uint8_t message[16384];
    if (app->control_every > 0 && w->now >= app->control_at) {
        uint32_t n = 8 + (uint32_t)world_random(w, 100);
        put32(message, app->start);
        put32(message + 4, app->control_next);
        for (uint32_t i = 8; i < n; i++)
            message[i] = (uint8_t)(app->control_next + i);
        if (pf_link_send_control(app->link, message, n) == PF_OK)
            w->control_sent_at[end][app->control_next++ % 256] = w->now;
        app->control_at = w->now + app->control_every;
    }
    if (app->latest_every > 0 && w->now >= app->latest_at) {
        uint32_t topic = (uint32_t)world_random(w, 3), number = app->latest_next[topic];
        uint32_t n = topic == 0 ? 60 : app->latest_size;
        put32(message, app->start);
        put32(message + 4, number);
        for (uint32_t i = 8; i < n; i++)
            message[i] = (uint8_t)(number * 3 + i);
        if (pf_link_send_latest(app->link, topic, message, n) == PF_OK)
            app->latest_next[topic]++;
        app->latest_at = w->now + app->latest_every;
    }
    for (uint32_t id = 0; id < app->objects && pf_link_free_send_slots(app->link) > 0; id++)
        if (!app->given[id] && !app->sent[id] && !app->refused[id]) {
            uint8_t name[PF_LINK_NAME_SIZE];
            make_name(name, end, id);
            TEST_ASSERT_EQUAL_INT(
                PF_OK, pf_link_send_object(app->link, name, PF_OBJECT_KEYFRAME, contents[end][id], app->sizes[id]));
            app->given[id] = true;
        }
    for (uint32_t i = 0; i < PF_LINK_SLOTS_MAX; i++)
        if (app->questions[i].open && w->now >= app->questions[i].at) {
            app->questions[i].open = false;
            TEST_ASSERT_EQUAL_INT(PF_OK,
                                  pf_link_answer_object(app->link, app->questions[i].slot, app->questions[i].answer));
        }
}

/* Reads, answers, writes; asserts that a deadline that has come has a frame or an event behind it. */
static void serve(world *w, uint32_t end)
{
    world_app *app = &w->apps[end];
    uint8_t bytes[2048];
    size_t n = pf_sim_line_read(w->line, end, bytes, sizeof bytes, w->now);
    for (size_t done = 0; done < n;) {
        done += pf_link_input(app->link, bytes + done, n - done, w->now);
        take_events(w, end);
    }
    say_things(w, end);
    size_t room = pf_sim_line_room(w->line, end, w->now);
    if (room < PF_LINK_FRAME_MAX)
        return;
    bool due = pf_link_deadline(app->link, w->now) <= w->now;
    size_t made = pf_link_output(app->link, bytes, room < sizeof bytes ? room : sizeof bytes, w->now);
    pf_sim_line_write(w->line, end, bytes, made, w->now);
    uint32_t events = app->ups + app->downs;
    take_events(w, end);
    if (due)
        TEST_ASSERT_TRUE_MESSAGE(made > 0 || app->ups + app->downs > events,
                                 "due, but nothing to do: a loop would spin");
    else
        TEST_ASSERT_EQUAL_size_t_MESSAGE(0, made, "output before the deadline: a loop would be late");
}

static uint64_t earlier(uint64_t a, uint64_t b)
{
    return a < b ? a : b;
}

/* When something can happen next: exactly what a daemon's poll loop knows. */
static uint64_t next_time(const world *w)
{
    uint64_t at = UINT64_MAX;
    for (uint32_t end = 0; end < 2; end++) {
        const world_app *app = &w->apps[end];
        uint64_t deadline = pf_link_deadline(app->link, w->now);
        uint64_t room = pf_sim_line_room_at(w->line, end, PF_LINK_FRAME_MAX);
        at = earlier(at, deadline > room ? deadline : room);
        at = earlier(at, pf_sim_line_arrival(w->line, end));
        if (app->control_every > 0)
            at = earlier(at, app->control_at);
        if (app->latest_every > 0)
            at = earlier(at, app->latest_at);
        for (uint32_t i = 0; i < PF_LINK_SLOTS_MAX; i++)
            if (app->questions[i].open)
                at = earlier(at, app->questions[i].at);
    }
    return at;
}

static void step(world *w, uint64_t limit)
{
    for (uint32_t end = 0; end < 2; end++)
        serve(w, end);
    /* A reader is woken some bytes later, not for each. */
    uint64_t at = next_time(w), soonest = w->now + WORLD_MS / 5;
    TEST_ASSERT_TRUE_MESSAGE(at != UINT64_MAX, "nothing would ever happen again");
    w->now = earlier(at > soonest ? at : soonest, limit > soonest ? limit : soonest);
}

bool world_done(const world *w)
{
    for (uint32_t end = 0; end < 2; end++)
        for (uint32_t id = 0; id < w->apps[end].objects; id++)
            if (!w->apps[end].sent[id] && !w->apps[end].refused[id])
                return false;
    return true;
}

bool world_run(world *w, uint64_t limit)
{
    uint64_t end = w->now + limit;
    while (!world_done(w) && w->now < end)
        step(w, end);
    return world_done(w);
}

void world_pass(world *w, uint64_t duration)
{
    uint64_t end = w->now + duration;
    while (w->now < end)
        step(w, end);
}
