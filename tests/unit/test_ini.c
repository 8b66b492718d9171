#include "config.h"
#include "ini.h"
#include "utf8.h"

#include <stdlib.h>
#include <string.h>

#include "unity.h"

void setUp(void) {}
void tearDown(void) {}

typedef struct seen {
    char text[4096];
} seen;

static bool note(void *user, const pf_ini_item *item, char *error, size_t n)
{
    seen *s = user;
    size_t used = strlen(s->text);
    (void)snprintf(s->text + used, sizeof s->text - used, "%u:%s.%s=<%s>\n", item->line, item->section, item->key,
                   item->value);
    if (strcmp(item->key, "refuse") == 0) {
        (void)snprintf(error, n, "refused");
        return false;
    }
    return true;
}

static const char *parse(const char *text, char *error, size_t n)
{
    static seen s;
    s.text[0] = '\0';
    error[0] = '\0';
    (void)pf_ini_parse(text, strlen(text), "f", note, &s, error, n);
    return s.text;
}

/* Proves: the grammar: sections, white space, comments, quotes, CRLF, a last line without an end, and the mark that
 * Windows' editors begin a file with. */
static void test_ini_takes_what_its_header_says(void)
{
    char error[256];
    TEST_ASSERT_EQUAL_STRING(
        "2:a.x=<1>\n3:a.y=<two words>\n4:a.z=<>\n6:b-2.x=< # ; kept >\n7:b-2.y=<p#1;2>\n9:b-2.z=<e=f>\n",
        parse("[a] # first\nx=1\n  y  =  two words   ; comment\nz =  # nothing\n[ b-2 ]\nx = \" # ; kept \" # c\n"
              "y = p#1;2\r\n; whole line\nz = e=f",
              error, sizeof error));
    TEST_ASSERT_EQUAL_STRING("", error);
    TEST_ASSERT_EQUAL_STRING("2:a.x=<1>\n", parse("\xEF\xBB\xBF[a]\r\nx = 1\r\n", error, sizeof error));
    TEST_ASSERT_EQUAL_STRING("", error);
    TEST_ASSERT_EQUAL_STRING("", parse("\xEF\xBB\xBF", error, sizeof error));
    TEST_ASSERT_EQUAL_STRING("", error);
    (void)parse("[a]\n\xEF\xBB\xBFx = 1", error, sizeof error);
    TEST_ASSERT_EQUAL_STRING("f:2: a key is made of letters, digits, _ and -", error);
}

/* Proves: each malformed line is refused, with file and line, and nothing after it is taken. */
static void test_ini_refuses_malformed_lines_with_their_place(void)
{
    static const char *const cases[][2] = {
        {"x = 1", "f:1: a key before the first [section]"},
        {"[a]\n\nnonsense", "f:3: neither [section] nor key = value"},
        {"[a\nx=1", "f:1: no ] after the section's name"},
        {"[]", "f:1: a section's name is made of letters, digits, _ and -"},
        {"[a b]", "f:1: a section's name is made of letters, digits, _ and -"},
        {"[a] b", "f:1: text after the section's ]"},
        {"[a]\n= 1", "f:2: a key is made of letters, digits, _ and -"},
        {"[a]\nx y = 1", "f:2: a key is made of letters, digits, _ and -"},
        {"[a]\nx = \"1", "f:2: no closing quote"},
        {"[a]\nx = \"1\"2", "f:2: text after the closing quote"},
        {"[a]\nx = \"1\" 2", "f:2: text after the closing quote"},
        {"[a]\nx = 1\nrefuse = 2\nx = 3", "f:3: refused"},
    };
    char error[256];
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        (void)parse(cases[i][0], error, sizeof error);
        TEST_ASSERT_EQUAL_STRING(cases[i][1], error);
    }
}

static void test_ini_refuses_long_lines_and_zero_bytes(void)
{
    char text[PF_INI_LINE_MAX + 16], error[256];
    seen s = {""};
    memset(text, 'x', sizeof text);
    memcpy(text, "[a]\nk=", 6);
    TEST_ASSERT_TRUE(pf_ini_parse(text, 4 + PF_INI_LINE_MAX, "f", note, &s, error, sizeof error));
    TEST_ASSERT_FALSE(pf_ini_parse(text, 4 + PF_INI_LINE_MAX + 1, "f", note, &s, error, sizeof error));
    TEST_ASSERT_EQUAL_STRING("f:2: line longer than 1024 bytes", error);
    TEST_ASSERT_FALSE(pf_ini_parse("[a]\nx\0=1", 8, "f", note, &s, error, sizeof error));
    TEST_ASSERT_EQUAL_STRING("f:2: a zero byte: not a text file", error);
}

/* What --help-config prints. */
static char *help(size_t *n)
{
    char *text = NULL;
    FILE *out = open_memstream(&text, n);
    TEST_ASSERT_NOT_NULL(out);
    pf_config_print_help(out);
    (void)fclose(out);
    return text;
}

/* Proves: the printed documentation is a valid file with every key, and its values are the defaults: key by key the
 * same as without any file. Also that the table's own defaults are in range (pf_config_defaults aborts otherwise). */
static void test_the_printed_documentation_sets_every_default(void)
{
    static pf_config plain, parsed;
    char error[512], a[PF_CONFIG_LINE_MAX], b[PF_CONFIG_LINE_MAX];
    size_t n;
    char *text = help(&n);
    pf_config_defaults(&plain);
    pf_config_defaults(&parsed);
    TEST_ASSERT_TRUE_MESSAGE(pf_config_parse(&parsed, text, n, "help", error, sizeof error), error);
    for (uint32_t i = 0; i < pf_config_keys(); i++) {
        (void)pf_config_line(&plain, i, a, sizeof a);
        (void)pf_config_line(&parsed, i, b, sizeof b);
        TEST_ASSERT_EQUAL_STRING(a, b);
        TEST_ASSERT_TRUE_MESSAGE(parsed.line[i] > 0, a);
    }
    free(text);
}

/* Proves: a file cut off anywhere, or with any one byte changed to anything, is parsed or refused with file and line;
 * never more than that (the sanitizers watch). */
static void test_config_survives_truncation_and_garbage(void)
{
    static pf_config config;
    char error[512];
    size_t n;
    char *text = help(&n);
    static const char garbage[] = {'\0', '\n', '"', '=', '[', ']', '#', '-', '9', (char)0xFF};
    for (size_t cut = 0; cut < n; cut++) {
        memset(config.line, 0, sizeof config.line);
        if (!pf_config_parse(&config, text, cut, "f", error, sizeof error))
            TEST_ASSERT_EQUAL_INT(0, strncmp(error, "f:", 2));
    }
    for (size_t at = 0; at < n; at += 3) {
        char was = text[at];
        text[at] = garbage[at / 3 % sizeof garbage];
        memset(config.line, 0, sizeof config.line);
        if (!pf_config_parse(&config, text, n, "f", error, sizeof error))
            TEST_ASSERT_EQUAL_INT(0, strncmp(error, "f:", 2));
        text[at] = was;
    }
    free(text);
}

static void check_refused(const char *text, const char *expected)
{
    static pf_config config;
    char error[1024] = "";
    pf_config_defaults(&config);
    TEST_ASSERT_FALSE_MESSAGE(pf_config_parse(&config, text, strlen(text), "f", error, sizeof error), text);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, expected), error);
}

static void test_config_refuses_bad_values(void)
{
    check_refused("[tracker]\nmax_tracks = 7", "f:2: tracker.max_tracks = 7: must be 8..2048");
    check_refused("[tracker]\nmax_tracks = 2049", "must be 8..2048");
    check_refused("[tracker]\nmax_tracks =", "not a number");
    check_refused("[tracker]\nmax_tracks = 0x10", "not a number");
    check_refused("[tracker]\nmax_tracks = 8.5", "not a whole number");
    check_refused("[tracker]\nfb_px = nan", "not a number");
    check_refused("[tracker]\nfb_px = inf", "not a number");
    check_refused("[tracker]\nfb_px = 1e999", "not a number");
    check_refused("[camera]\nspeed = slow", "camera.speed = slow: this build has: recorded|fast");
    check_refused("[camera]\nspeed = recorded|fast", "this build has");
    check_refused("[link]\nrtscts = 1", "must be true or false");
    check_refused("[survey]\nname = \xC3(", "not UTF-8");
    check_refused("[link]\nport = 1\n[link]\nport = 1", "f:4: link.port is set a second time; the first is in line 2");
    check_refused("[link]\nprot = 1", "unknown key prot in [link]; it has: transport device");
    check_refused("[lnk]\nport = 1",
                  "unknown section [lnk]; there are: survey camera tracker keyframe encoder gpio link");
}

static void test_config_override_wins_and_settings_are_checked_together(void)
{
    static pf_config c;
    char error[512];
    pf_config_defaults(&c);
    TEST_ASSERT_FALSE(pf_config_check(&c, "f", error, sizeof error));
    TEST_ASSERT_EQUAL_STRING("f: camera.path: must be set: the recording to play; or camera.driver, for a camera",
                             error);
    TEST_ASSERT_TRUE(pf_config_parse(&c, "[camera]\npath = a = b", 21, "f", error, sizeof error));
    TEST_ASSERT_TRUE(pf_config_override(&c, "camera.path=x.y4m=z", error, sizeof error));
    TEST_ASSERT_EQUAL_STRING("x.y4m=z", c.camera.path);
    TEST_ASSERT_TRUE(pf_config_check(&c, "f", error, sizeof error));
    TEST_ASSERT_TRUE(pf_config_override(&c, "link.transport=serial", error, sizeof error));
    TEST_ASSERT_FALSE(pf_config_check(&c, "f", error, sizeof error));
    TEST_ASSERT_FALSE(pf_config_override(&c, "link=serial", error, sizeof error));
    TEST_ASSERT_FALSE(pf_config_override(&c, "camera=a.b", error, sizeof error));
    TEST_ASSERT_FALSE(pf_config_override(&c, "link.baud=1", error, sizeof error));
    TEST_ASSERT_EQUAL_STRING("--set link.baud=1: link.baud = 1: must be 9600..4000000 baud", error);
}

/* Proves: only UTF-8 without control characters passes (cases of RFC 3629), and cleaning makes it so. */
static void test_texts_are_utf8(void)
{
    static const char *const good[] = {
        "", "a", "\xC3\x96", "\xE2\x82\xAC", "\xF0\x9F\x90\x9F", "\xED\x9F\xBF", "\xF4\x8F\xBF\xBF"};
    static const char *const bad[] = {"\x80",         "\xC0\xAF",     "\xC3",     "\xE0\x80\xAF",
                                      "\xED\xA0\x80", "\xF0\x80\x80", "\xE2\x82", "\xF4\x90\x80\x80",
                                      "\xFF",         "\n",           "\x7F",     "a\xE2\x82(b"};
    for (size_t i = 0; i < sizeof good / sizeof good[0]; i++)
        TEST_ASSERT_TRUE(pf_utf8_check(good[i]));
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        char text[16];
        (void)snprintf(text, sizeof text, "%s", bad[i]);
        TEST_ASSERT_FALSE(pf_utf8_check(text));
        pf_utf8_clean(text);
        TEST_ASSERT_TRUE(pf_utf8_check(text));
        TEST_ASSERT_EQUAL_size_t(strlen(bad[i]), strlen(text));
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_ini_takes_what_its_header_says);
    RUN_TEST(test_ini_refuses_malformed_lines_with_their_place);
    RUN_TEST(test_ini_refuses_long_lines_and_zero_bytes);
    RUN_TEST(test_the_printed_documentation_sets_every_default);
    RUN_TEST(test_config_survives_truncation_and_garbage);
    RUN_TEST(test_config_refuses_bad_values);
    RUN_TEST(test_config_override_wins_and_settings_are_checked_together);
    RUN_TEST(test_texts_are_utf8);
    return UNITY_END();
}
