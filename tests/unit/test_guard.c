/* What a daemon that hangs or fails is known by: the pulse of a thread (pulse.c), and what starts leave behind for the
 * next ones (recall.c). Threads that hang inside the whole daemon: tests/python/test_daemon_guard.py. */
#include "pipefish/drivers/clock.h"
#include "pulse.h"
#include "recall.h"
#include "temporary.h"
#include "unity.h"
#include "worker.h"

#include <poll.h>

#define LIMIT_NS 50000000u

void setUp(void) {}
void tearDown(void) {}

static const char *hung(void)
{
    return pf_pulse_hung(pf_now(), LIMIT_NS);
}

static const char *wait_for_hung(void)
{
    for (int i = 0; i < 3000 && hung() == NULL; i++)
        (void)poll(NULL, 0, 10);
    return hung();
}

/* After longer than a thread may work on one thing; a busy machine gets more time. */
static bool is_well_again(void)
{
    bool is_well = false;
    (void)poll(NULL, 0, 60);
    for (int i = 0; i < 3000 && !is_well; i++) {
        (void)poll(NULL, 0, 10);
        is_well = hung() == NULL;
    }
    return is_well;
}

static _Atomic bool is_hanging;

static void track(void *user, void *item)
{
    (void)user;
    (void)item;
    while (is_hanging)
        (void)poll(NULL, 0, 5);
}

/* Proves: a tracking thread that does not come to an end with a frame hangs; one that waits for a frame does not. */
static void test_a_tracker_that_hangs_is_named(void)
{
    pf_worker *worker;
    char error[128];
    int frame = 1;
    TEST_ASSERT_TRUE(pf_worker_open(&worker, track, NULL, error, sizeof error));
    TEST_ASSERT_TRUE(is_well_again());
    is_hanging = true;
    pf_worker_give(worker, &frame);
    TEST_ASSERT_EQUAL_STRING("tracking", wait_for_hung());
    is_hanging = false;
    pf_worker_wait(worker);
    TEST_ASSERT_TRUE(is_well_again());
    pf_worker_close(worker);
}

/* Proves: a thread that knows nothing of pulses, as the GPIO driver's, hangs when it has not gone round for long. */
static void test_a_round_that_does_not_come_is_named(void)
{
    const uint64_t now = pf_now();
    pf_pulse_note(PF_PULSE_GPIO, now);
    TEST_ASSERT_NULL(pf_pulse_hung(now, LIMIT_NS));
    pf_pulse_note(PF_PULSE_GPIO, pf_now() - 2 * LIMIT_NS);
    TEST_ASSERT_EQUAL_STRING("GPIO", hung());
    pf_pulse_note(PF_PULSE_GPIO, 0);
    TEST_ASSERT_NULL(hung());
}

/* ---- starts */

static const char *folder, *file;

/* A start of the daemon; whether it would take the settings of the last good run. */
static bool start(pf_recall *recall)
{
    char path[512];
    pf_recall_begin(recall, folder, file);
    return pf_recall_is_due(recall, path, sizeof path);
}

/* The board is switched off, and on again: the kernel has another boot id. */
static void cut_power(void)
{
    char text[256], path[512];
    (void)snprintf(path, sizeof path, "%s/starts", folder);
    FILE *f = fopen(path, "r+");
    TEST_ASSERT_NOT_NULL(f);
    TEST_ASSERT_NOT_NULL(fgets(text, sizeof text, f));
    char *boot = strchr(strchr(text, ' ') + 1, ' ') + 1;
    TEST_ASSERT_TRUE(strlen(boot) >= 36);
    memcpy(boot, "00000000", 8);
    rewind(f);
    TEST_ASSERT_TRUE(fputs(text, f) >= 0);
    TEST_ASSERT_EQUAL_INT(0, fclose(f));
}

static void begin_history(const char *name)
{
    static pf_config config;
    pf_recall recall;
    pf_config_defaults(&config);
    folder = temporary_path(name);
    file = temporary_text("settings.ini", name);
    TEST_ASSERT_FALSE(start(&recall));
    pf_recall_good(&recall, &config);
}

/* Proves: any number of power cuts of a daemon that was up and well leaves the settings in force. */
static void test_power_cuts_are_no_failed_starts(void)
{
    pf_recall recall;
    begin_history("cuts");
    for (int i = 0; i < 10; i++) {
        TEST_ASSERT_FALSE(start(&recall));
        pf_recall_up(&recall, true);
        cut_power();
    }
}

/* Proves: three starts that failed take the settings of the last good run: by crashes, also after they were up; by
 * resets of the board before they were up, or after a thread had begun to hang; power cuts in between change nothing.
 */
static void test_starts_that_fail_are_counted(void)
{
    static const char *const names[] = {"crashes", "early", "hangs", "mixed"};
    pf_recall recall;
    for (size_t how = 0; how < 4; how++) {
        begin_history(names[how]);
        for (int i = 0; i < 3; i++) {
            TEST_ASSERT_FALSE_MESSAGE(start(&recall), names[how]);
            if (how != 1)
                pf_recall_up(&recall, true);
            if (how == 2)
                pf_recall_up(&recall, false);
            if (how == 1 || how == 2)
                cut_power();
            if (how == 3 && i < 2) {
                TEST_ASSERT_FALSE(start(&recall)); /* the one before crashed; this one loses its power */
                pf_recall_up(&recall, true);
                cut_power();
            }
        }
        TEST_ASSERT_TRUE_MESSAGE(start(&recall), names[how]);
    }
}

int main(void)
{
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_a_tracker_that_hangs_is_named);
    RUN_TEST(test_a_round_that_does_not_come_is_named);
    RUN_TEST(test_power_cuts_are_no_failed_starts);
    RUN_TEST(test_starts_that_fail_are_counted);
    temporary_remove();
    return UNITY_END();
}
