#include "survey.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/random.h>

#include "config.h"
#include "log.h"

#define FORMAT 2u  /* of the packed survey: its first byte */
#define HEADER 61u /* bytes before the ranges */

static void put_u32(uint8_t *out, uint32_t value)
{
    for (int i = 0; i < 4; i++)
        out[i] = (uint8_t)(value >> (8 * i));
}

static uint32_t get_u32(const uint8_t *in)
{
    return (uint32_t)in[0] | (uint32_t)in[1] << 8 | (uint32_t)in[2] << 16 | (uint32_t)in[3] << 24;
}

size_t pf_survey_pack(const pf_survey *s, uint8_t *out)
{
    uint32_t n = 0;
    out[0] = FORMAT;
    memcpy(out + 1, s->id, 16);
    memcpy(out + 17, s->setup, 32);
    put_u32(out + 49, s->boots);
    put_u32(out + 53, s->next_index);
    for (; n < s->lost_ranges && s->lost_first[n] < s->next_index; n++) {
        uint32_t before = s->next_index - s->lost_first[n];
        put_u32(out + HEADER + 8 * n, s->lost_first[n]);
        put_u32(out + HEADER + 8 * n + 4, s->lost_count[n] < before ? s->lost_count[n] : before);
    }
    put_u32(out + 57, n);
    return HEADER + 8 * (size_t)n;
}

/* What pack() makes always is so; a host would take ranges beyond all that was made for losses. */
static bool is_possible(const pf_survey *s)
{
    uint64_t after = 0; /* the last range */
    for (uint32_t i = 0; i < s->lost_ranges; i++) {
        if (s->lost_count[i] == 0 || s->lost_first[i] < after + (i > 0))
            return false;
        after = (uint64_t)s->lost_first[i] + s->lost_count[i];
    }
    return s->boots > 0 && after <= s->next_index;
}

static bool unpack(pf_survey *s, const uint8_t *in, size_t n)
{
    if (n < HEADER || in[0] != FORMAT || get_u32(in + 57) > PF_SURVEY_LOST_MAX ||
        n != HEADER + 8 * (size_t)get_u32(in + 57))
        return false;
    memcpy(s->id, in + 1, 16);
    memcpy(s->setup, in + 17, 32);
    s->boots = get_u32(in + 49);
    s->next_index = get_u32(in + 53);
    s->lost_ranges = get_u32(in + 57);
    for (uint32_t i = 0; i < s->lost_ranges; i++) {
        s->lost_first[i] = get_u32(in + HEADER + 8 * i);
        s->lost_count[i] = get_u32(in + HEADER + 8 * i + 4);
    }
    return is_possible(s);
}

bool pf_survey_open(pf_survey *survey, pf_survey *before, const pf_spool *spool, const uint8_t setup[32], char *error,
                    size_t n)
{
    uint8_t bytes[PF_SURVEY_BYTES];
    size_t size = 0;
    pf_status status = spool->ops->get(spool->self, PF_SURVEY_KEY, bytes, sizeof bytes, &size);
    memset(survey, 0, sizeof *survey);
    memset(before, 0, sizeof *before);
    if (status == PF_OK && unpack(survey, bytes, size)) {
        if (memcmp(survey->setup, setup, sizeof survey->setup) == 0) {
            survey->is_resumed = true;
            survey->boots++;
            return true;
        }
        *before = *survey;
    } else if (status == PF_OK || status == PF_ERR_SPACE) { /* it will never be better: nobody waits for that */
        pf_log(PF_LOG_ERROR, "the survey that the spool remembers is damaged, or of another version: another begins, "
                             "and that one has no end");
        status = PF_OK;
    }
    memset(survey, 0, sizeof *survey);
    if (status != PF_OK && status != PF_ERR_END) {
        (void)snprintf(error, n, "%s", spool->ops->error(spool->self));
        return false;
    }
    if (getrandom(survey->id, sizeof survey->id, 0) != (ssize_t)sizeof survey->id) {
        (void)snprintf(error, n, "no random numbers: %s", strerror(errno));
        return false;
    }
    memcpy(survey->setup, setup, sizeof survey->setup);
    survey->boots = 1;
    return true;
}

/* Makes one range of range i and the next. */
static void join(pf_survey *s, uint32_t i)
{
    size_t rest = s->lost_ranges - i - 2;
    s->lost_count[i] = s->lost_first[i + 1] + s->lost_count[i + 1] - s->lost_first[i];
    memmove(s->lost_first + i + 1, s->lost_first + i + 2, rest * sizeof *s->lost_first);
    memmove(s->lost_count + i + 1, s->lost_count + i + 2, rest * sizeof *s->lost_count);
    s->lost_ranges--;
}

/* Of several equal distances the oldest: what lies there has most likely been delivered. */
static void join_closest(pf_survey *s)
{
    uint32_t best = 0, least = UINT32_MAX;
    for (uint32_t i = 0; i + 1 < s->lost_ranges; i++) {
        uint32_t distance = s->lost_first[i + 1] - s->lost_first[i] - s->lost_count[i];
        if (distance < least) {
            least = distance;
            best = i;
        }
    }
    join(s, best);
}

void pf_survey_lose(pf_survey *s, uint32_t index)
{
    uint32_t at = s->lost_ranges; /* the first range after index */
    while (at > 0 && s->lost_first[at - 1] > index)
        at--;
    if (at > 0 && index - s->lost_first[at - 1] < s->lost_count[at - 1])
        return;
    if (at > 0 && index - s->lost_first[at - 1] == s->lost_count[at - 1]) {
        s->lost_count[at - 1]++;
        if (at < s->lost_ranges && s->lost_first[at] == index + 1)
            join(s, at - 1);
        return;
    }
    if (at < s->lost_ranges && s->lost_first[at] == index + 1) {
        s->lost_first[at]--;
        s->lost_count[at]++;
        return;
    }
    if (s->lost_ranges == PF_SURVEY_LOST_MAX) {
        join_closest(s);
        pf_survey_lose(s, index); /* may lie in the joined range */
        return;
    }
    memmove(s->lost_first + at + 1, s->lost_first + at, (s->lost_ranges - at) * sizeof *s->lost_first);
    memmove(s->lost_count + at + 1, s->lost_count + at, (s->lost_ranges - at) * sizeof *s->lost_count);
    s->lost_first[at] = index;
    s->lost_count[at] = 1;
    s->lost_ranges++;
}

uint32_t pf_survey_importance(uint32_t index)
{
    uint32_t importance = 0;
    for (; index != 0 && index % 2 == 0; index /= 2)
        importance++;
    return importance;
}
