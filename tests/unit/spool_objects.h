/* What the spool's tests have in common: one spool, and objects whose bytes follow from a number. */
#ifndef PIPEFISH_TESTS_SPOOL_OBJECTS_H
#define PIPEFISH_TESTS_SPOOL_OBJECTS_H

#include "pipefish/drivers/sha256.h"
#include "pipefish/drivers/spool.h"
#include "temporary.h"
#include "unity.h"

static pf_spool spool;
static char error[512];

void setUp(void) {}

static inline void close_spool(void)
{
    if (spool.self != NULL)
        spool.ops->close(spool.self);
    spool.self = NULL;
}

void tearDown(void)
{
    close_spool();
}

static inline void open_spool(const char *name, uint64_t quota)
{
    pf_spool_config config = {.path = temporary_path(name), .quota = quota};
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_spool_open(&spool, &config, error, sizeof error), error);
}

/* Object `id`: its bytes follow from the id alone, the first eight are the id. */
#define OBJECT_MAX 60000u
static uint8_t object_bytes[OBJECT_MAX], object_name[32], read_bytes[OBJECT_MAX];

static inline size_t make_object(uint64_t id)
{
    uint64_t random = id;
    size_t n = 16 + temporary_random(&random) % (OBJECT_MAX - 16);
    n -= n % 8;
    for (size_t i = 0; i < n; i += 8) {
        uint64_t word = temporary_random(&random);
        memcpy(object_bytes + i, &word, 8);
    }
    memcpy(object_bytes, &id, sizeof id);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256(object_bytes, n, object_name));
    return n;
}

static inline pf_status put(uint64_t id)
{
    size_t n = make_object(id);
    return spool.ops->put(spool.self, 2, object_name, object_bytes, n);
}

static inline pf_spool_stats stats(void)
{
    pf_spool_stats s;
    spool.ops->stats(spool.self, &s);
    return s;
}

/* Reads an item, checks that it is byte for byte the object it says it is, and returns its id. */
static inline uint64_t check_item(const pf_spool_item *item)
{
    uint64_t id;
    size_t n = 0;
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->read(spool.self, item, read_bytes, sizeof read_bytes, &n));
    TEST_ASSERT_EQUAL_size_t(item->size, n);
    memcpy(&id, read_bytes, sizeof id);
    TEST_ASSERT_EQUAL_size_t(make_object(id), n);
    TEST_ASSERT_EQUAL_MEMORY(object_bytes, read_bytes, n);
    TEST_ASSERT_EQUAL_MEMORY(object_name, item->name, 32);
    return id;
}

static inline size_t slurp(const char *path, uint8_t *bytes, size_t capacity)
{
    FILE *f = fopen(path, "rb");
    TEST_ASSERT_NOT_NULL(f);
    size_t n = fread(bytes, 1, capacity, f);
    fclose(f);
    return n;
}

#endif
