/* Proves: of what is told again and again a line a second is left, which says how many are not; other lines come
 * through all the while; no text is too long, none makes a second line, and every line ends. */
#include "config.h"
#include "log.h"
#include "unity.h"

#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

static FILE *caught;
static int own = -1;
static uint64_t later_ns;

/* The clock that log.c asks (--wrap). */
int __real_clock_gettime(clockid_t id, struct timespec *t);
int __wrap_clock_gettime(clockid_t id, struct timespec *t);

int __wrap_clock_gettime(clockid_t id, struct timespec *t)
{
    (void)id;
    *t = (struct timespec){(time_t)(1000 + later_ns / 1000000000u), (long)(later_ns % 1000000000u)};
    return 0;
}

void setUp(void)
{
    caught = tmpfile();
    own = dup(STDERR_FILENO);
    TEST_ASSERT_TRUE(caught != NULL && own >= 0);
    TEST_ASSERT_EQUAL_INT(STDERR_FILENO, dup2(fileno(caught), STDERR_FILENO));
}

void tearDown(void)
{
    (void)dup2(own, STDERR_FILENO);
    (void)close(own);
    (void)fclose(caught);
}

/* Lines since the last look that contain `part`; all end. */
static uint32_t count(const char *part)
{
    static long seen;
    char line[2048];
    uint32_t n = 0;
    if (part == NULL) {
        seen = 0;
        return 0;
    }
    (void)fseek(caught, seen, SEEK_SET);
    while (fgets(line, sizeof line, caught) != NULL) {
        TEST_ASSERT_EQUAL_INT('\n', line[strlen(line) - 1]);
        TEST_ASSERT_TRUE(strlen(line) <= 1024);
        n += strstr(line, part) != NULL;
    }
    seen = ftell(caught);
    (void)fseek(caught, 0, SEEK_END);
    return n;
}

static void chatter(uint32_t n)
{
    while (n-- > 0)
        pf_log(PF_LOG_WARNING, "switch %u", n);
}

static void test_what_is_told_again_and_again_is_left_out_and_counted(void)
{
    (void)count(NULL);
    chatter(1000);
    TEST_ASSERT_EQUAL_UINT32(60, count("switch"));
    pf_log(PF_LOG_ERROR, "the disk has gone");
    TEST_ASSERT_EQUAL_UINT32(1, count("the disk has gone"));
    later_ns += 1500000000u;
    chatter(20);
    TEST_ASSERT_EQUAL_UINT32(1, count("switch 19 (and 940 more like it)"));
    later_ns += 500000000u; /* two seconds in all: one more */
    chatter(1);
    TEST_ASSERT_EQUAL_UINT32(1, count("switch 0 (and 19 more like it)"));
    later_ns += UINT64_C(3600000000000);
    chatter(1000);
    TEST_ASSERT_EQUAL_UINT32(60, count("switch"));
}

/* What is only "%s" is one format for the whole program. */
static void test_an_error_is_told_whatever_news_there_were(void)
{
    (void)count(NULL);
    for (int i = 0; i < 200; i++)
        pf_log(PF_LOG_INFO, "%s", "host is there");
    pf_log(PF_LOG_ERROR, "%s", "it does not start");
    TEST_ASSERT_EQUAL_UINT32(1, count("it does not start"));
    later_ns += UINT64_C(3600000000000);
}

static void test_no_text_makes_a_line_of_its_own(void)
{
    (void)count(NULL);
    pf_log(PF_LOG_WARNING, "host %s: %s", "a\n<3>pipefishd: error: forged", "\r\x1b[2Jb\x7f\xc3\xa9\n");
    TEST_ASSERT_EQUAL_UINT32(1, count("host a <3>pipefishd: error: forged:   [2Jb \xc3\xa9 \n"));
}

static void test_long_lines_end(void)
{
    char text[3000];
    (void)count(NULL);
    memset(text, 'x', sizeof text - 1);
    for (size_t n = 900; n < sizeof text; n += n < 1100 ? 1 : 500) {
        text[n] = '\0';
        later_ns += UINT64_C(1000000000);
        pf_log(PF_LOG_INFO, "%s", text);
        text[n] = 'x';
        TEST_ASSERT_EQUAL_UINT32(1, count("xxx"));
    }
    for (uint32_t i = 0; i < 100; i++)
        pf_log(PF_LOG_INFO, "%1000s", "x");
    later_ns += UINT64_C(1000000000);
    pf_log(PF_LOG_INFO, "%1000s", "x");
    TEST_ASSERT_EQUAL_UINT32(61, count("x"));
}

static void *tell(void *text)
{
    for (int i = 0; i < 1000; i++)
        pf_log(PF_LOG_INFO, "thread %s", (const char *)text);
    return NULL;
}

static void test_threads_share_the_limit(void)
{
    pthread_t threads[4];
    (void)count(NULL);
    for (int i = 0; i < 4; i++)
        TEST_ASSERT_EQUAL_INT(0, pthread_create(&threads[i], NULL, tell, "n"));
    for (int i = 0; i < 4; i++)
        (void)pthread_join(threads[i], NULL);
    TEST_ASSERT_EQUAL_UINT32(60, count("thread n"));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_what_is_told_again_and_again_is_left_out_and_counted);
    RUN_TEST(test_an_error_is_told_whatever_news_there_were);
    RUN_TEST(test_no_text_makes_a_line_of_its_own);
    RUN_TEST(test_long_lines_end);
    RUN_TEST(test_threads_share_the_limit);
    return UNITY_END();
}
