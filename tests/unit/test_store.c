#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/sha256.h"
#include "pipefish/link.h"
#include "pulse.h"
#include "store_inside.h"
#include "temporary.h"
#include "unity.h"

#include <limits.h>
#include <poll.h>
#include <stdatomic.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

/* A spool in memory whose calls fail when told to. */
enum { OBJECTS_MAX = 32, BYTES_MAX = 512 };

static struct {
    pthread_mutex_t mutex;
    struct {
        pf_spool_item item;
        uint8_t bytes[BYTES_MAX];
    } object[OBJECTS_MAX];
    uint64_t rows;
    int fail_puts, fail_next, fail_reads, fail_removes; /* so many of the calls to come fail */
    bool is_full;                                       /* but for who gives something up */
    bool has_victims;                                   /* the first object */
    uint64_t healed, evicted;
    uint32_t kept;                  /* bit n: row n could not be removed */
    _Atomic bool is_hanging;        /* a write takes for ever */
    _Atomic bool is_counting;       /* so does a question for what there is, after something was given up */
    uint8_t value[PF_SURVEY_BYTES]; /* as stored with the newest object */
    size_t value_n;
} fake = {.mutex = PTHREAD_MUTEX_INITIALIZER};

static pf_store *_Atomic watched; /* NULL = none is open */
static _Atomic int asked_with_mutex;

/* Called by each call of the spool: the store's mutex, which tracking and link take, must be free, or they wait for the
 * disk. Others hold it for moments only; once one did not, no more is waited for. */
static void check_mutex(void)
{
    pf_store *s = atomic_load(&watched);
    for (int i = 0; s != NULL && i < 3000 && atomic_load(&asked_with_mutex) == 0; i++) {
        if (pthread_mutex_trylock(&s->mutex) == 0) {
            (void)pthread_mutex_unlock(&s->mutex);
            return;
        }
        (void)poll(NULL, 0, 10);
    }
    atomic_fetch_add(&asked_with_mutex, s != NULL);
}

static bool fails(int *count)
{
    check_mutex();
    return *count > 0 && (*count)--;
}

static pf_status exchange(void *self, const pf_spool_victim *victims, uint32_t count, uint32_t kind,
                          const uint8_t name[32], const void *bytes, size_t n, const pf_spool_rank *rank,
                          const char *key, const void *value, size_t value_n)
{
    pf_status status = PF_OK;
    (void)self;
    (void)rank;
    (void)key;
    while (fake.is_hanging)
        (void)poll(NULL, 0, 5);
    (void)pthread_mutex_lock(&fake.mutex);
    if (fake.is_full && count == 0) {
        status = PF_ERR_SPACE;
    } else if (fails(&fake.fail_puts)) {
        status = PF_ERR_IO;
    } else {
        pf_spool_item *item = &fake.object[fake.rows].item;
        memcpy(fake.object[fake.rows].bytes, bytes, n);
        *item = (pf_spool_item){.row = ++fake.rows, .kind = kind, .size = (uint32_t)n};
        memcpy(item->name, name, 32);
        memcpy(fake.value, value, value_n);
        fake.value_n = value_n;
        for (uint32_t i = 0; i < count; i++)
            fake.object[victims[i].row - 1].item.size = 0;
        fake.evicted += count;
        fake.is_counting = count > 0;
    }
    (void)pthread_mutex_unlock(&fake.mutex);
    return status;
}

static pf_status next(void *self, uint64_t after, pf_spool_item *item)
{
    pf_status status = PF_ERR_END;
    (void)self;
    (void)pthread_mutex_lock(&fake.mutex);
    if (fails(&fake.fail_next)) {
        status = PF_ERR_IO;
    } else {
        for (uint64_t row = after + 1; row <= fake.rows && status == PF_ERR_END; row++) {
            if (fake.object[row - 1].item.size > 0) {
                *item = fake.object[row - 1].item;
                status = PF_OK;
            }
        }
    }
    (void)pthread_mutex_unlock(&fake.mutex);
    return status;
}

static pf_status read_object(void *self, const pf_spool_item *item, void *bytes, size_t capacity, size_t *n)
{
    pf_status status = PF_OK;
    (void)self;
    (void)capacity;
    (void)pthread_mutex_lock(&fake.mutex);
    if (fails(&fake.fail_reads)) {
        status = PF_ERR_IO;
    } else {
        *n = fake.object[item->row - 1].item.size;
        memcpy(bytes, fake.object[item->row - 1].bytes, *n);
    }
    (void)pthread_mutex_unlock(&fake.mutex);
    return status;
}

static pf_status remove_object(void *self, uint64_t row)
{
    pf_status status = PF_OK;
    (void)self;
    (void)pthread_mutex_lock(&fake.mutex);
    if (fails(&fake.fail_removes)) {
        status = PF_ERR_IO;
        fake.kept |= 1u << row;
    } else {
        fake.object[row - 1].item.size = 0;
    }
    (void)pthread_mutex_unlock(&fake.mutex);
    return status;
}

static int victims_asked;

static pf_status victims(void *self, uint64_t after, uint32_t importance, size_t n,
                         pf_spool_victim found[PF_SPOOL_VICTIMS_MAX], uint32_t *count)
{
    (void)self;
    victims_asked++;
    (void)after;
    (void)importance;
    (void)n;
    *count = fake.has_victims;
    found[0] = (pf_spool_victim){.row = 1, .number = 0};
    return fake.has_victims ? PF_OK : PF_ERR_SPACE;
}

static pf_status keep_status;

static pf_status keep_all(void *self)
{
    (void)self;
    return keep_status;
}

static void get_stats(void *self, pf_spool_stats *stats)
{
    (void)self;
    check_mutex();
    while (fake.is_counting)
        (void)poll(NULL, 0, 5);
    memset(stats, 0, sizeof *stats);
    stats->healed = fake.healed;
    (void)pthread_mutex_lock(&fake.mutex);
    stats->evicted = fake.evicted;
    for (uint64_t i = 0; i < fake.rows; i++)
        stats->objects += fake.object[i].item.size > 0;
    (void)pthread_mutex_unlock(&fake.mutex);
}

static const char *get_error(void *self)
{
    (void)self;
    check_mutex();
    return "fake";
}

static const char *get_healing(void *self)
{
    (void)self;
    check_mutex();
    return "was damaged: 3 objects saved";
}

static const pf_spool_ops ops = {.next = next,
                                 .read = read_object,
                                 .remove = remove_object,
                                 .victims = victims,
                                 .exchange = exchange,
                                 .keep_all = keep_all,
                                 .stats = get_stats,
                                 .error = get_error,
                                 .healing = get_healing};
static pf_store *store;
static int wake_fd;

void setUp(void)
{
    pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
    memset((void *)&fake, 0, sizeof fake);
    keep_status = PF_OK;
    victims_asked = 0;
    fake.mutex = mutex;
    wake_fd = eventfd(0, EFD_NONBLOCK);
}

void tearDown(void)
{
    (void)close(wake_fd);
    TEST_ASSERT_EQUAL_INT(0, asked_with_mutex);
}

static void open_store(bool is_patient)
{
    const pf_spool spool = {NULL, &ops};
    const pf_survey survey = {.boots = 1};
    pf_store_config config = {
        .jobs = 4, .slots = 2, .capacity = BYTES_MAX, .is_patient = is_patient, .wake_fd = wake_fd};
    char error[256];
    TEST_ASSERT_TRUE_MESSAGE(pf_store_open(&store, &spool, &survey, &config, error, sizeof error), error);
    atomic_store(&watched, store);
}

static void give(uint32_t kind, uint32_t index, const char *break_reason)
{
    pf_job *job = pf_store_take(store);
    TEST_ASSERT_NOT_NULL(job);
    job->kind = kind;
    job->index = index;
    job->n = 2;
    job->bytes[0] = 0x10; /* the message's field index, a small number */
    job->bytes[1] = (uint8_t)index;
    (void)strncpy(job->break_reason, break_reason, sizeof job->break_reason - 1);
    pf_store_give(store, job);
}

static pf_store_stats stats(void)
{
    pf_store_stats s;
    pf_store_get_stats(store, &s);
    return s;
}

static void close_store(void)
{
    pf_store_quit(store);
    atomic_store(&watched, NULL);
    pf_store_close(store);
}

/* Waits for the next object to send; fails after half a minute. */
static pf_slot *wait_for_slot(void)
{
    pf_slot *slot;
    for (int i = 0; i < 3000; i++) {
        if ((slot = pf_store_next_slot(store)) != NULL)
            return slot;
        (void)poll(NULL, 0, 10);
    }
    TEST_FAIL_MESSAGE("no object to send");
    return NULL;
}

/* Whether the object in row `row` (from 1) has this break reason; "" = none. */
static void check_break(uint64_t row, uint8_t index, const char *reason)
{
    const uint8_t *bytes = fake.object[row - 1].bytes;
    uint32_t n = fake.object[row - 1].item.size;
    size_t length = strlen(reason);
    TEST_ASSERT_EQUAL_UINT8(index, bytes[1]);
    TEST_ASSERT_EQUAL_UINT32(length ? 2 + 2 + 2 + length : 2, n);
    if (length)
        TEST_ASSERT_EQUAL_MEMORY(reason, bytes + 6, length);
}

/* Proves: a break whose keyframe the disk loses is told by the next keyframe that is stored, and by that one only. */
static void test_a_break_outlives_the_keyframe_that_carried_it(void)
{
    open_store(false);
    give(PF_OBJECT_KEYFRAME, 0, "");
    pf_store_settle(store);
    fake.fail_puts = 2;
    give(PF_OBJECT_KEYFRAME, 1, "gap of 9 frames");
    give(PF_OBJECT_KEYFRAME, 2, "");
    give(PF_OBJECT_KEYFRAME, 3, "");
    pf_store_settle(store);
    give(PF_OBJECT_KEYFRAME, 4, "");
    give(PF_OBJECT_KEYFRAME, 5, "restart");
    pf_store_settle(store);
    close_store();
    TEST_ASSERT_EQUAL_UINT64(4, fake.rows);
    check_break(1, 0, "");
    check_break(2, 3, "gap of 9 frames");
    check_break(3, 4, "");
    check_break(4, 5, "restart");
}

/* Proves: a job that waits for room is stored as it was, its break told once. */
static void test_a_break_that_waits_for_room_is_told_once(void)
{
    open_store(true);
    fake.is_full = true;
    give(PF_OBJECT_KEYFRAME, 7, "gap of 9 frames");
    (void)poll(NULL, 0, 1200); /* two tries at least */
    (void)pthread_mutex_lock(&fake.mutex);
    fake.is_full = false;
    (void)pthread_mutex_unlock(&fake.mutex);
    pf_store_settle(store);
    close_store();
    TEST_ASSERT_EQUAL_UINT64(1, fake.rows);
    check_break(1, 7, "gap of 9 frames");
}

/* Proves: reading, listing and removing that fail once are tried again: every object comes out, oldest first, and goes.
 */
static void test_a_failing_disk_is_tried_again(void)
{
    open_store(false);
    fake.fail_reads = 1;
    give(PF_OBJECT_KEYFRAME, 0, "");
    give(PF_OBJECT_KEYFRAME, 1, "");
    pf_slot *first = wait_for_slot(), *second = wait_for_slot();
    TEST_ASSERT_EQUAL_UINT64(1, first->item.row);
    TEST_ASSERT_EQUAL_UINT64(2, second->item.row);
    (void)pthread_mutex_lock(&fake.mutex);
    fake.fail_removes = fake.fail_next = 1;
    (void)pthread_mutex_unlock(&fake.mutex);
    pf_store_release_slot(store, first->item.name, false);
    pf_store_release_slot(store, second->item.name, false);
    give(PF_OBJECT_KEYFRAME, 2, "");
    pf_slot *third = wait_for_slot();
    TEST_ASSERT_EQUAL_UINT64(3, third->item.row);
    pf_store_release_slot(store, third->item.name, false);
    for (int i = 0; i < 3000 && !pf_store_is_drained(store); i++)
        (void)poll(NULL, 0, 10);
    TEST_ASSERT_TRUE(pf_store_is_drained(store));
    close_store();
}

/* Until the store has tried in vain to remove these rows. */
static void wait_for_kept(uint32_t rows)
{
    uint32_t kept = 0;
    for (int i = 0; i < 3000 && kept != rows; i++) {
        (void)poll(NULL, 0, 10);
        (void)pthread_mutex_lock(&fake.mutex);
        kept = fake.kept;
        (void)pthread_mutex_unlock(&fake.mutex);
    }
    TEST_ASSERT_EQUAL_HEX32(rows, kept);
}

/* Proves: a medium from which nothing can be removed keeps nothing from being sent, and what the host has stays and
 * counts until it can go: then it is offered once more, and goes. */
static void test_what_cannot_be_removed_stays_and_keeps_nothing_back(void)
{
    open_store(false);
    fake.fail_removes = INT_MAX;
    for (uint32_t i = 0; i < 4; i++)
        give(PF_OBJECT_KEYFRAME, i, "");
    for (uint64_t row = 1; row <= 4; row++) {
        pf_slot *slot = wait_for_slot();
        TEST_ASSERT_EQUAL_UINT64(row, slot->item.row);
        pf_store_release_slot(store, slot->item.name, false);
    }
    wait_for_kept(1u << 1 | 1u << 2 | 1u << 3 | 1u << 4);
    TEST_ASSERT_EQUAL_STRING("fake", stats().trouble);
    TEST_ASSERT_FALSE(pf_store_is_drained(store));
    TEST_ASSERT_EQUAL_UINT64(4, stats().spool.objects);
    TEST_ASSERT_NULL(pf_store_next_slot(store)); /* none twice while it cannot go */
    (void)pthread_mutex_lock(&fake.mutex);
    fake.fail_removes = 0;
    (void)pthread_mutex_unlock(&fake.mutex);
    for (uint64_t row = 2; row <= 4; row++) {
        pf_slot *slot = wait_for_slot();
        TEST_ASSERT_EQUAL_UINT64(row, slot->item.row);
        pf_store_release_slot(store, slot->item.name, false);
    }
    for (int i = 0; i < 3000 && !pf_store_is_drained(store); i++)
        (void)poll(NULL, 0, 10);
    TEST_ASSERT_TRUE(pf_store_is_drained(store));
    TEST_ASSERT_EQUAL_STRING("", stats().trouble);
    close_store();
}

/* Proves: on a disk that is full already at the start the daemon begins all the same, so that what is there can be
 * sent; nothing of the surveys before is given up until the disk has taken that they are to be kept. */
static void test_a_disk_that_is_full_at_the_start_gives_nothing_up(void)
{
    keep_status = PF_ERR_SPACE;
    fake.is_full = true;
    open_store(false);
    give(PF_OBJECT_KEYFRAME, 0, "");
    pf_store_settle(store);
    TEST_ASSERT_EQUAL_INT(0, victims_asked);
    TEST_ASSERT_EQUAL_UINT64(1, stats().keyframes_dropped);
    (void)pthread_mutex_lock(&fake.mutex);
    keep_status = PF_OK;
    (void)pthread_mutex_unlock(&fake.mutex);
    give(PF_OBJECT_KEYFRAME, 1, "");
    pf_store_settle(store);
    TEST_ASSERT_EQUAL_INT(1, victims_asked);
    close_store();
}

/* Proves: who has waited until all is stored sees at once how many objects there are and how many were given up, though
 * the store's thread has not asked the spool yet: the status that a survey's end tells is right. */
static void test_what_is_given_up_counts_as_soon_as_the_queue_is_empty(void)
{
    open_store(false);
    give(PF_OBJECT_KEYFRAME, 0, "");
    pf_store_settle(store);
    (void)pthread_mutex_lock(&fake.mutex);
    fake.is_full = fake.has_victims = true;
    (void)pthread_mutex_unlock(&fake.mutex);
    give(PF_OBJECT_KEYFRAME, 1, "");
    pf_store_settle(store);
    const pf_store_stats s = stats();
    fake.is_counting = false;
    close_store();
    TEST_ASSERT_EQUAL_UINT64(2, fake.rows);
    TEST_ASSERT_EQUAL_UINT64(1, s.spool.objects);
    TEST_ASSERT_EQUAL_UINT64(1, s.spool.evicted);
}

/* After longer than a thread may work on one thing; a busy machine gets more time. */
static bool is_well_again(void)
{
    bool is_well = false;
    (void)poll(NULL, 0, 60);
    for (int i = 0; i < 3000 && !is_well; i++) {
        (void)poll(NULL, 0, 10);
        is_well = pf_pulse_hung(pf_now(), 50000000) == NULL;
    }
    return is_well;
}

/* Proves: a disk that takes for ever makes the store a thread that hangs, for whoever feeds the watchdogs; one that
 * waits for work, or for a full disk, does not hang. */
static void test_a_disk_that_hangs_starves_the_watchdogs(void)
{
    const char *hung = NULL;
    open_store(true);
    TEST_ASSERT_TRUE(is_well_again());
    fake.is_full = true;
    give(PF_OBJECT_KEYFRAME, 0, "");
    TEST_ASSERT_TRUE(is_well_again());
    fake.is_hanging = true;
    for (int i = 0; i < 3000 && hung == NULL; i++) {
        (void)poll(NULL, 0, 10);
        hung = pf_pulse_hung(pf_now(), 50000000);
    }
    TEST_ASSERT_EQUAL_STRING("store", hung);
    fake.is_full = false;
    fake.is_hanging = false;
    pf_store_settle(store);
    TEST_ASSERT_TRUE(is_well_again());
    close_store();
}

/* Proves: what is stored with a keyframe never lists a keyframe that the next boot will make again as lost. */
static void test_losses_of_later_keyframes_are_not_kept(void)
{
    pf_survey kept;
    open_store(false);
    pf_store_lose(store, 1);
    pf_store_lose(store, 6); /* lost while number 5 still waited for the disk */
    give(PF_OBJECT_KEYFRAME, 5, "");
    pf_store_settle(store);
    pf_store_get_survey(store, &kept);
    TEST_ASSERT_EQUAL_UINT32(2, kept.lost_ranges);
    kept.lost_ranges = 1; /* number 1 */
    uint8_t expected[PF_SURVEY_BYTES];
    TEST_ASSERT_EQUAL_size_t(pf_survey_pack(&kept, expected), fake.value_n);
    TEST_ASSERT_EQUAL_MEMORY(expected, fake.value, fake.value_n);
    close_store();
}

/* Proves: flushing ends the wait for room, and what comes after the end counts as lost, not as stored. */
static void test_flush_and_quit_count_what_is_lost(void)
{
    open_store(true);
    fake.is_full = true;
    give(PF_OBJECT_KEYFRAME, 0, "");
    give(PF_OBJECT_SURVEY_END, 0, "");
    pf_job *late = pf_store_take(store);
    pf_store_flush(store);
    pf_store_settle(store);
    TEST_ASSERT_EQUAL_UINT64(1, stats().keyframes_dropped);
    TEST_ASSERT_TRUE(stats().has_failed);
    fake.is_full = false;
    atomic_store(&watched, NULL);
    pf_store_quit(store);
    late->kind = PF_OBJECT_KEYFRAME;
    late->index = 1;
    pf_store_give(store, late);
    TEST_ASSERT_EQUAL_UINT64(2, stats().keyframes_dropped);
    TEST_ASSERT_EQUAL_UINT64(0, fake.rows);
    pf_store_close(store);
}

/* ---- eviction, with the real spool */

enum { MADE = 100, ROOM = 20, EVENT = 33 };

/* The keyframes that a host would get from a spool, in order; the object in `slot` last. */
static uint32_t list_spool(const pf_spool *real, uint8_t *indices)
{
    pf_spool_item item = {.row = 0};
    uint32_t count = 0;
    while (real->ops->next(real->self, item.row, &item) == PF_OK) {
        uint8_t bytes[BYTES_MAX];
        size_t n;
        TEST_ASSERT_EQUAL_INT(PF_OK, real->ops->read(real->self, &item, bytes, sizeof bytes, &n));
        indices[count++] = bytes[1];
    }
    return count;
}

static bool is_lost(const pf_survey *survey, uint32_t index)
{
    for (uint32_t i = 0; i < survey->lost_ranges; i++)
        if (index >= survey->lost_first[i] && index - survey->lost_first[i] < survey->lost_count[i])
            return true;
    return false;
}

/* Proves: a live survey that outgrows its quota keeps the keyframes at which something happened and, of the others,
 * those that are spread over all of it, none of those that are being sent gone; every keyframe is in the spool or named
 * as lost, never both, in the same transaction. Once the survey is over, what is left of it is not touched by the next.
 */
static void test_a_full_spool_gives_up_the_least_important(void)
{
    pf_spool real;
    pf_survey survey = {.boots = 1};
    const pf_spool_config quota = {.path = temporary_path("evict.db"), .quota = ROOM * 100};
    pf_store_config config = {.jobs = 4, .slots = 2, .capacity = BYTES_MAX, .wake_fd = wake_fd};
    char error[256];
    uint8_t there[MADE], value[PF_SURVEY_BYTES], expected[PF_SURVEY_BYTES];
    size_t value_n;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_spool_open(&real, &quota, error, sizeof error));
    TEST_ASSERT_TRUE_MESSAGE(pf_store_open(&store, &real, &survey, &config, error, sizeof error), error);
    for (uint32_t i = 0; i < MADE; i++) {
        pf_job *job = pf_store_take(store);
        TEST_ASSERT_NOT_NULL(job);
        job->kind = PF_OBJECT_KEYFRAME;
        job->index = i;
        job->is_event = i == 0 || i == EVENT;
        job->n = 100;
        memset(job->bytes, 0x10, 100);
        job->bytes[1] = (uint8_t)i;
        pf_store_give(store, job);
        pf_store_settle(store);
        if (i == 1) { /* two are on their way to the host from now on */
            TEST_ASSERT_EQUAL_UINT64(1, wait_for_slot()->item.row);
            TEST_ASSERT_EQUAL_UINT64(2, wait_for_slot()->item.row);
        }
    }
    pf_store_get_survey(store, &survey);
    const pf_store_stats s = stats();
    close_store();
    uint32_t n = list_spool(&real, there), at = 0, most_gap = 0;
    TEST_ASSERT_EQUAL_UINT32(ROOM, n);
    TEST_ASSERT_EQUAL_UINT64(MADE - ROOM, s.spool.evicted + s.keyframes_dropped);
    TEST_ASSERT_TRUE(s.spool.evicted >= ROOM);
    for (uint32_t i = 0; i < MADE; i++) {
        bool is_there = at < n && there[at] == i;
        TEST_ASSERT_TRUE_MESSAGE(is_there != is_lost(&survey, i), "in the spool, or named as lost");
        if (i <= 1 || i == EVENT)
            TEST_ASSERT_TRUE_MESSAGE(is_there, "an event, or on its way");
        if (is_there && at > 0 && (uint32_t)(there[at] - there[at - 1]) > most_gap)
            most_gap = there[at] - there[at - 1];
        at += is_there;
    }
    TEST_ASSERT_TRUE_MESSAGE(most_gap <= 8, "100 keyframes in the room of 20: spread, not cut off");
    TEST_ASSERT_EQUAL_INT(PF_OK, real.ops->get(real.self, PF_SURVEY_KEY, value, sizeof value, &value_n));
    if (s.keyframes_dropped == 0) /* else the last ones were lost without a transaction */
        TEST_ASSERT_EQUAL_size_t(pf_survey_pack(&survey, expected), value_n);
    /* Another survey: nothing of the first is its to give up. */
    survey = (pf_survey){.boots = 1};
    TEST_ASSERT_TRUE(pf_store_open(&store, &real, &survey, &config, error, sizeof error));
    give(PF_OBJECT_KEYFRAME, 64, "");
    pf_job *job = pf_store_take(store);
    job->kind = PF_OBJECT_KEYFRAME;
    job->index = 128;
    job->n = 100;
    memset(job->bytes, 0x20, 100);
    pf_store_give(store, job);
    pf_store_settle(store);
    TEST_ASSERT_EQUAL_UINT64(0, stats().spool.evicted - s.spool.evicted);
    TEST_ASSERT_TRUE(stats().keyframes_dropped >= 1);
    TEST_ASSERT_NOT_NULL(strstr(stats().trouble, "less important"));
    close_store();
    TEST_ASSERT_EQUAL_UINT32(ROOM, list_spool(&real, there));
    real.ops->close(real.self);
}

int main(void)
{
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_a_break_outlives_the_keyframe_that_carried_it);
    RUN_TEST(test_a_break_that_waits_for_room_is_told_once);
    RUN_TEST(test_a_failing_disk_is_tried_again);
    RUN_TEST(test_what_cannot_be_removed_stays_and_keeps_nothing_back);
    RUN_TEST(test_a_disk_that_is_full_at_the_start_gives_nothing_up);
    RUN_TEST(test_what_is_given_up_counts_as_soon_as_the_queue_is_empty);
    RUN_TEST(test_a_disk_that_hangs_starves_the_watchdogs);
    RUN_TEST(test_losses_of_later_keyframes_are_not_kept);
    RUN_TEST(test_flush_and_quit_count_what_is_lost);
    RUN_TEST(test_a_full_spool_gives_up_the_least_important);
    int failures = UNITY_END();
    temporary_remove();
    return failures;
}
