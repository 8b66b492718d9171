#include "replay.h"
#include "temporary.h"
#include "unity.h"

void setUp(void) {}
void tearDown(void) {}

#define HASH "00112233445566778899aabbccddeeffFFEEDDCCBBAA99887766554433221100"

static pf_csv csv;
static pf_failure failure;

static pf_status parse(const char *text)
{
    failure.text[0] = '\0';
    return pf_csv_parse(&csv, text, strlen(text), "some/demo.csv", &failure);
}

/* The text must be refused with PF_ERR_FORMAT and a message that holds all of `words` (separated by '|'). */
static void refused(const char *text, const char *words)
{
    char copy[256], *rest = NULL;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_ERR_FORMAT, parse(text), text);
    TEST_ASSERT_NULL(csv.rows);
    (void)snprintf(copy, sizeof copy, "%s", words);
    for (const char *word = strtok_r(copy, "|", &rest); word != NULL; word = strtok_r(NULL, "|", &rest))
        if (strstr(failure.text, word) == NULL) {
            printf("\"%s\" is missing in \"%s\"\n", word, failure.text);
            TEST_FAIL_MESSAGE(text);
        }
}

/* Proves: every column arrives where it belongs, whatever the order; empty cells are unknown. */
static void test_all_columns_in_any_order(void)
{
    TEST_ASSERT_EQUAL_INT(PF_OK, parse("lamp,sha256,time_ns,gain,roll_rad,attitude_sigma_rad,pitch_rad,exposure_us,"
                                       "encoder_count,sequence\n"
                                       "0.5," HASH ",1000,2.5,-0.25,0.01,3e-1,8000,-42,7\n"
                                       ",,2000,,,,,,,9\n"));
    TEST_ASSERT_EQUAL_UINT64(2, csv.n);
    const pf_csv_row *row = &csv.rows[0];
    TEST_ASSERT_EQUAL_UINT64(7, row->sequence);
    TEST_ASSERT_EQUAL_UINT64(1000, row->time_ns);
    TEST_ASSERT_TRUE(row->telemetry.has_encoder && row->telemetry.has_attitude && row->telemetry.has_exposure &&
                     row->telemetry.has_gain && row->telemetry.has_lamp && row->has_sha256);
    TEST_ASSERT_EQUAL_INT64(-42, row->telemetry.encoder_count);
    TEST_ASSERT_EQUAL_DOUBLE(-0.25, row->telemetry.roll_rad);
    TEST_ASSERT_EQUAL_DOUBLE(0.3, row->telemetry.pitch_rad);
    TEST_ASSERT_EQUAL_DOUBLE(0.01, row->telemetry.attitude_sigma_rad);
    TEST_ASSERT_EQUAL_UINT32(8000, row->telemetry.exposure_us);
    TEST_ASSERT_EQUAL_DOUBLE(2.5, row->telemetry.gain);
    TEST_ASSERT_EQUAL_DOUBLE(0.5, row->telemetry.lamp);
    TEST_ASSERT_EQUAL_HEX8(0x11, row->sha256[1]);
    TEST_ASSERT_EQUAL_HEX8(0xFF, row->sha256[16]);
    row = &csv.rows[1];
    TEST_ASSERT_EQUAL_UINT64(9, row->sequence);
    TEST_ASSERT_FALSE(row->telemetry.has_encoder || row->telemetry.has_attitude || row->telemetry.has_exposure ||
                      row->telemetry.has_gain || row->telemetry.has_lamp || row->has_sha256);
    pf_csv_free(&csv);
}

/* Proves: what spreadsheets do to a file is accepted: CRLF, byte order mark, blanks, blank lines at the end, no newline
 * at the end. */
static void test_spreadsheet_dialects(void)
{
    static const char *const texts[] = {
        "sequence,time_ns\r\n1,10\r\n2,20\r\n",
        "\xEF\xBB\xBFsequence,time_ns\n1,10\n2,20",
        " sequence ,\ttime_ns\n 1,10 \n2 , 20\n\n\r\n",
    };
    for (size_t i = 0; i < sizeof texts / sizeof texts[0]; i++) {
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, parse(texts[i]), failure.text);
        TEST_ASSERT_EQUAL_UINT64(2, csv.n);
        TEST_ASSERT_EQUAL_UINT64(20, csv.rows[1].time_ns);
        pf_csv_free(&csv);
    }
}

/* Proves: each kind of mistake is refused, and the message names file, line and column. */
static void test_mistakes_are_named(void)
{
    refused("", "some/demo.csv:1|empty");
    refused("sequence,time_ns,speed\n", "some/demo.csv:1|column 3|speed");
    refused("sequence,time_ns,lamp,lamp\n", "some/demo.csv:1|column 4|lamp");
    refused("sequence,lamp\n", "some/demo.csv:1|time_ns");
    refused("time_ns\n", "some/demo.csv:1|sequence");
    refused("sequence,time_ns,\n", "some/demo.csv:1|column 3");
    refused("sequence,time_ns\n1,2\n2\n", "some/demo.csv:3|column 2|1 cells");
    refused("sequence,time_ns\n1,2,3\n", "some/demo.csv:2|column 3|3 cells");
    refused("sequence,time_ns\n1,\n", "some/demo.csv:2|column time_ns");
    refused("sequence,time_ns\n1.5,2\n", "some/demo.csv:2|column sequence|1.5");
    refused("sequence,time_ns\n-1,2\n", "some/demo.csv:2|column sequence|-1");
    refused("sequence,time_ns\n9223372036854775808,2\n", "some/demo.csv:2|column sequence");
    refused("sequence,time_ns\n1,99999999999999999999999\n", "some/demo.csv:2|column time_ns");
    refused("sequence,time_ns\n1,2\n1,3\n", "some/demo.csv:3|column sequence|increase");
    refused("sequence,time_ns\n1,2\n2,2\n", "some/demo.csv:3|column time_ns|increase");
    refused("sequence,time_ns\n1,2\n\n2,3\n", "some/demo.csv:4|blank");
    refused("sequence,time_ns,encoder_count\n1,2,1e3\n", "some/demo.csv:2|column encoder_count|1e3");
    refused("sequence,time_ns,exposure_us\n1,2,4294967296\n", "some/demo.csv:2|column exposure_us");
    refused("sequence,time_ns,gain\n1,2,nan\n", "some/demo.csv:2|column gain|nan");
    refused("sequence,time_ns,gain\n1,2,0x10\n", "some/demo.csv:2|column gain|0x10");
    refused("sequence,time_ns,gain\n1,2,1e999\n", "some/demo.csv:2|column gain");
    refused("sequence,time_ns,gain\n1,2,-1\n", "some/demo.csv:2|column gain");
    refused("sequence,time_ns,gain\n1,2,1-1\n", "some/demo.csv:2|column gain");
    refused("sequence,time_ns,lamp\n1,2,1.01\n", "some/demo.csv:2|column lamp");
    refused("sequence,time_ns,sha256\n1,2,abcd\n", "some/demo.csv:2|column sha256");
    refused("sequence,time_ns,roll_rad,pitch_rad\n1,2,7,0\n", "some/demo.csv:2|column roll_rad");
    refused("sequence,time_ns,roll_rad,pitch_rad\n1,2,1,\n", "some/demo.csv:2|column pitch_rad");
    refused("sequence,time_ns,pitch_rad\n1,2,1\n", "some/demo.csv:2|column roll_rad");
    refused("sequence,time_ns,attitude_sigma_rad\n1,2,0.1\n", "some/demo.csv:2|column roll_rad|attitude_sigma_rad");
    refused("sequence,time_ns,roll_rad,pitch_rad,attitude_sigma_rad\n1,2,0,0,0\n",
            "some/demo.csv:2|column attitude_sigma_rad");
    refused("sequence,time_ns\n1,\xB2\n", "some/demo.csv:2|0xB2");
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT,
                          pf_csv_parse(&csv, "sequence,time_ns\n1,\0002\n", 22, "some/demo.csv", &failure));
}

/* Proves: an attitude without its sigma is an attitude whose sigma is not stated. */
static void test_attitude_without_sigma(void)
{
    TEST_ASSERT_EQUAL_INT(PF_OK, parse("sequence,time_ns,roll_rad,pitch_rad\n1,2,0.5,-0.5\n"));
    TEST_ASSERT_TRUE(csv.rows[0].telemetry.has_attitude);
    TEST_ASSERT_EQUAL_DOUBLE(0, csv.rows[0].telemetry.attitude_sigma_rad);
    pf_csv_free(&csv);
}

static const char whole[] = "sequence,time_ns,encoder_count,roll_rad,pitch_rad,attitude_sigma_rad,lamp,sha256\n"
                            "0,100,1,0.1,0.2,0.01,0.5," HASH "\n"
                            "1,200,2,0.1,0.2,0.01,0.5," HASH "\n"
                            "3,300,,,,,,\n";

static void check_answer(pf_status status)
{
    if (status == PF_OK) {
        for (uint64_t i = 1; i < csv.n; i++)
            TEST_ASSERT_TRUE(csv.rows[i].sequence > csv.rows[i - 1].sequence &&
                             csv.rows[i].time_ns > csv.rows[i - 1].time_ns);
        pf_csv_free(&csv);
    } else {
        TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, status);
        TEST_ASSERT_NULL(csv.rows);
        TEST_ASSERT_EQUAL_INT(0, strncmp(failure.text, "some/demo.csv:", 14));
    }
}

/* Proves: a file cut at any byte gives its whole rows or a message, never rows that were not there. */
static void test_truncation_at_each_byte(void)
{
    size_t n = sizeof whole - 1;
    for (size_t cut = 0; cut <= n; cut++) {
        char *exact = malloc(cut + 1); /* its own block: the sanitizer sees one byte too far */
        TEST_ASSERT_NOT_NULL(exact);
        memcpy(exact, whole, cut);
        char *shrunk = realloc(exact, cut > 0 ? cut : 1);
        failure.text[0] = '\0';
        pf_status status = pf_csv_parse(&csv, shrunk, cut, "some/demo.csv", &failure);
        if (status == PF_OK)
            TEST_ASSERT_TRUE(csv.n <= 3);
        check_answer(status);
        free(shrunk);
    }
}

/* Proves: random changes and random bytes are parsed or refused with a message; run under the sanitizers. */
static void test_mutations_and_garbage(void)
{
    static const char letters[] = "0123456789,,,\n\n\r.-+eE aq\"";
    uint64_t random = 1;
    char bytes[sizeof whole];
    for (int round = 0; round < 20000; round++) {
        size_t n = sizeof whole - 1;
        memcpy(bytes, whole, n);
        for (uint64_t k = 1 + temporary_random(&random) % 4; k > 0; k--)
            bytes[temporary_random(&random) % n] = round % 2 == 0
                                                       ? letters[temporary_random(&random) % (sizeof letters - 1)]
                                                       : (char)temporary_random(&random);
        failure.text[0] = '\0';
        check_answer(pf_csv_parse(&csv, bytes, n, "some/demo.csv", &failure));
    }
}

/* Proves: a missing file is told from an unreadable one. */
static void test_file_errors(void)
{
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, pf_csv_read(&csv, temporary_path("missing.csv"), &failure));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, pf_csv_read(&csv, temporary_root, &failure));
    TEST_ASSERT_NOT_NULL(strstr(failure.text, temporary_root));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_csv_read(&csv, temporary_text("some.csv", whole), &failure));
    TEST_ASSERT_EQUAL_UINT64(3, csv.n);
    pf_csv_free(&csv);
}

int main(void)
{
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_all_columns_in_any_order);
    RUN_TEST(test_spreadsheet_dialects);
    RUN_TEST(test_mistakes_are_named);
    RUN_TEST(test_attitude_without_sigma);
    RUN_TEST(test_truncation_at_each_byte);
    RUN_TEST(test_mutations_and_garbage);
    RUN_TEST(test_file_errors);
    temporary_remove();
    return UNITY_END();
}
