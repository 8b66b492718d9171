/* A reader of Protocol Buffers' wire format (varints, lengths, fixed fields) that knows nothing of nanopb or a schema:
 * fields by their numbers. Damage fails the test. */
#ifndef PIPEFISH_TEST_WIRE_H
#define PIPEFISH_TEST_WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "unity.h"

typedef struct view {
    const uint8_t *data;
    size_t n;
} view;

static inline uint64_t varint(view *v)
{
    uint64_t value = 0;
    for (unsigned shift = 0;; shift += 7) {
        uint8_t byte;
        TEST_ASSERT_TRUE_MESSAGE(v->n > 0 && shift < 64, "varint cut off");
        byte = *v->data++;
        v->n--;
        value |= (uint64_t)(byte & 0x7F) << shift;
        if (!(byte & 0x80))
            return value;
    }
}

static inline int64_t zigzag(uint64_t value)
{
    return (int64_t)(value >> 1) ^ -(int64_t)(value & 1);
}

static inline view take(view *v, size_t n)
{
    view taken = {v->data, n};
    TEST_ASSERT_TRUE_MESSAGE(v->n >= n, "field cut off");
    v->data += n;
    v->n -= n;
    return taken;
}

/* The last occurrence of a field; *count gets how many there are. A number comes as its bits, bytes as a view. */
static inline bool find(view message, uint32_t field, uint64_t *number, view *bytes, uint32_t *count)
{
    bool is_found = false;
    *count = 0;
    while (message.n > 0) {
        uint64_t tag = varint(&message), value = 0;
        view contents = {NULL, 0};
        switch (tag & 7) {
        case 0:
            value = varint(&message);
            break;
        case 1:
            contents = take(&message, 8);
            memcpy(&value, contents.data, 8);
            break;
        case 2:
            contents = take(&message, (size_t)varint(&message));
            break;
        case 5:
            contents = take(&message, 4);
            memcpy(&value, contents.data, 4);
            break;
        default:
            TEST_FAIL_MESSAGE("unknown wire type");
        }
        if (tag >> 3 != field)
            continue;
        is_found = true;
        (*count)++;
        *number = value;
        *bytes = contents;
    }
    return is_found;
}

static inline uint64_t number(view message, uint32_t field)
{
    uint64_t value = 0;
    view bytes;
    uint32_t count;
    return find(message, field, &value, &bytes, &count) ? value : 0;
}

static inline view bytes(view message, uint32_t field)
{
    uint64_t value;
    view contents = {NULL, 0};
    uint32_t count;
    (void)find(message, field, &value, &contents, &count);
    return contents;
}

static inline bool has(view message, uint32_t field)
{
    uint64_t value;
    view contents;
    uint32_t count;
    return find(message, field, &value, &contents, &count);
}

static inline float real32(view message, uint32_t field)
{
    uint64_t bits = number(message, field);
    float value;
    memcpy(&value, &bits, 4);
    return value;
}

static inline double real64(view message, uint32_t field)
{
    uint64_t bits = number(message, field);
    double value;
    memcpy(&value, &bits, 8);
    return value;
}

static inline void check_text(const char *expected, view got)
{
    TEST_ASSERT_EQUAL_size_t(strlen(expected), got.n);
    TEST_ASSERT_EQUAL_MEMORY(expected, got.data, got.n);
}

#endif
