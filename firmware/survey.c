#include "survey.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/random.h>

#define FORMAT 1u /* of the packed survey: its first byte */

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
    out[0] = FORMAT;
    memcpy(out + 1, s->id, 16);
    put_u32(out + 17, s->boots);
    put_u32(out + 21, s->next_index);
    put_u32(out + 25, s->lost_count);
    for (uint32_t i = 0; i < s->lost_count; i++)
        put_u32(out + 29 + 4 * i, s->lost[i]);
    return 29 + 4 * (size_t)s->lost_count;
}

static bool unpack(pf_survey *s, const uint8_t *in, size_t n)
{
    if (n < 29 || in[0] != FORMAT || get_u32(in + 25) > PF_SURVEY_LOST_MAX || n != 29 + 4 * (size_t)get_u32(in + 25))
        return false;
    memcpy(s->id, in + 1, 16);
    s->boots = get_u32(in + 17);
    s->next_index = get_u32(in + 21);
    s->lost_count = get_u32(in + 25);
    for (uint32_t i = 0; i < s->lost_count; i++)
        s->lost[i] = get_u32(in + 29 + 4 * i);
    return true;
}

bool pf_survey_open(pf_survey *survey, const pf_spool *spool, char *error, size_t n)
{
    uint8_t bytes[PF_SURVEY_BYTES];
    size_t size = 0;
    pf_status status = spool->ops->get(spool->self, PF_SURVEY_KEY, bytes, sizeof bytes, &size);
    memset(survey, 0, sizeof *survey);
    if (status == PF_OK && unpack(survey, bytes, size)) {
        survey->is_resumed = true;
        survey->boots++;
        return true;
    }
    if (status == PF_OK) {
        (void)snprintf(error, n, "the survey that the spool remembers was written by another version");
        return false;
    }
    if (status != PF_ERR_END) {
        (void)snprintf(error, n, "%s", spool->ops->error(spool->self));
        return false;
    }
    if (getrandom(survey->id, sizeof survey->id, 0) != (ssize_t)sizeof survey->id) {
        (void)snprintf(error, n, "no random numbers: %s", strerror(errno));
        return false;
    }
    survey->boots = 1;
    return true;
}

void pf_survey_lose(pf_survey *survey, uint32_t index)
{
    if (survey->lost_count < PF_SURVEY_LOST_MAX)
        survey->lost[survey->lost_count++] = index;
}
