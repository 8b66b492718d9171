/* The file that behaves like a flash memory.
 *
 * Proves: the file appears whole and durably; what the store counts on happens in the right order: data, fdatasync, and
 * only then the record; other files, other processes and failing disks are errors that say so. The system calls that
 * matter are this program's own, which note the call, fail when told, and pass it on.
 * Does not prove: behaviour of a disk that lies about flush. */
#include "pipefish/drivers/flash_file.h"
#include "pipefish/profile_store.h"
#include "unity.h"

#include "temporary.h"

#include <errno.h>
#include <fcntl.h>
#include <sys/syscall.h>

static char calls[256]; /* p = pwrite, d = fdatasync, f = fsync of a file, F = of a folder, l = link */
static int failing;     /* errno of every pwrite and fdatasync from now on; 0 = none */

static void note(char call)
{
    size_t n = strlen(calls);
    if (n + 1 < sizeof calls && (n == 0 || calls[n - 1] != 'p' || call != 'p')) /* writes in a row count once */
        calls[n] = call;
}

static bool fails(void)
{
    errno = failing;
    return failing != 0;
}

ssize_t pwrite(int fd, const void *bytes, size_t n, off_t at)
{
    note('p');
    return fails() ? -1 : (ssize_t)syscall(SYS_pwrite64, fd, bytes, n, at);
}

int fdatasync(int fd)
{
    note('d');
    return fails() ? -1 : (int)syscall(SYS_fdatasync, fd);
}

int fsync(int fd)
{
    struct stat info;
    note(fstat(fd, &info) == 0 && S_ISDIR(info.st_mode) ? 'F' : 'f');
    return (int)syscall(SYS_fsync, fd);
}

int link(const char *from, const char *to)
{
    note('l');
    return (int)syscall(SYS_linkat, AT_FDCWD, from, AT_FDCWD, to, 0);
}

static pf_flash flash;
static uint8_t scratch[PF_FLASH_FILE_PROGRAM_SIZE];
static char error[256];

void setUp(void)
{
    memset(calls, 0, sizeof calls);
    failing = 0;
    error[0] = '\0';
}
void tearDown(void) {}

static pf_status open_file(const char *path, bool is_read_only)
{
    return pf_flash_file_open(&flash, &(pf_flash_file_config){path, is_read_only}, error, sizeof error);
}

static void test_a_new_file_is_durable_before_its_name_and_the_name_before_use(void)
{
    uint8_t bytes[4] = {0};
    const char *path = temporary_path("new.store");
    TEST_ASSERT_EQUAL_INT(PF_OK, open_file(path, false));
    TEST_ASSERT_EQUAL_STRING("pflF", calls);
    TEST_ASSERT_EQUAL_INT(PF_OK, flash.ops->read(flash.self, 65532, bytes, 4));
    TEST_ASSERT_EACH_EQUAL_HEX8(0xFF, bytes, 4);
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, flash.ops->read(flash.self, 65533, bytes, 4));
    pf_flash_file_close(&flash);
}

static void test_the_record_is_written_after_the_profile_is_durable(void)
{
    pf_profile_store store;
    uint8_t bytes[5000], back[8192];
    size_t n = 0;
    memset(bytes, 0x5A, sizeof bytes);
    const char *path = temporary_path("order.store");
    TEST_ASSERT_EQUAL_INT(PF_OK, open_file(path, false));
    TEST_ASSERT_TRUE(pf_profile_store_scratch_size(&flash) > 0 &&
                     pf_profile_store_scratch_size(&flash) <= sizeof scratch);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_open(&store, &flash, scratch));
    memset(calls, 0, sizeof calls);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_write(&store, bytes, sizeof bytes, 1));
    TEST_ASSERT_EQUAL_STRING("pdpdpd", calls); /* slot, record, its copy */
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
    pf_flash_file_close(&flash);

    TEST_ASSERT_EQUAL_INT(PF_OK, open_file(path, true)); /* another program may look */
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_open(&store, &flash, scratch));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_load(&store, back, sizeof back, &n, NULL));
    TEST_ASSERT_EQUAL_size_t(sizeof bytes, n);
    TEST_ASSERT_EQUAL_MEMORY(bytes, back, n);
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, pf_profile_store_write(&store, bytes, sizeof bytes, 1)); /* but not write */
    pf_flash_file_close(&flash);
}

static void test_a_failing_disk_is_an_error_and_the_profile_stays(void)
{
    pf_profile_store store;
    uint8_t bytes[100] = {1}, back[8192];
    size_t n = 0;
    TEST_ASSERT_EQUAL_INT(PF_OK, open_file(temporary_path("full.store"), false));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_open(&store, &flash, scratch));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_write(&store, bytes, sizeof bytes, 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
    failing = EIO;
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, pf_profile_store_write(&store, bytes, 50, 1));
    failing = 0;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_open(&store, &flash, scratch));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_load(&store, back, sizeof back, &n, NULL));
    TEST_ASSERT_EQUAL_size_t(sizeof bytes, n);
    pf_flash_file_close(&flash);

    failing = ENOSPC;
    const char *path = temporary_path("never.store");
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, open_file(path, false));
    TEST_ASSERT_NOT_NULL(strstr(error, "No space left"));
    TEST_ASSERT_EQUAL_INT(-1, access(path, F_OK));
}

static void test_what_is_no_store_or_in_use_is_refused(void)
{
    pf_flash other;
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, open_file(temporary_path("absent.store"), true));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, open_file(temporary_path("no/such/folder.store"), false));
    TEST_ASSERT_NOT_NULL(strstr(error, "No such file"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, open_file(temporary_text("text.store", "hello"), false));
    TEST_ASSERT_NOT_NULL(strstr(error, "text.store: not a profile store"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, open_file(temporary_root, true));
    const char *path = temporary_path("busy.store");
    TEST_ASSERT_EQUAL_INT(PF_OK, open_file(path, false));
    other = flash;
    TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, open_file(path, false));
    TEST_ASSERT_NOT_NULL(strstr(error, "another process"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, other.ops->program(other.self, 100, scratch, 4096));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, other.ops->program(other.self, 65536, scratch, 4096));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, other.ops->erase(other.self, PF_FLASH_FILE_SECTORS));
    pf_flash_file_close(&other);
}

int main(void)
{
    UNITY_BEGIN();
    temporary_make();
    RUN_TEST(test_a_new_file_is_durable_before_its_name_and_the_name_before_use);
    RUN_TEST(test_the_record_is_written_after_the_profile_is_durable);
    RUN_TEST(test_a_failing_disk_is_an_error_and_the_profile_stays);
    RUN_TEST(test_what_is_no_store_or_in_use_is_refused);
    temporary_remove();
    return UNITY_END();
}
