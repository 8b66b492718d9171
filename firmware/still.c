#include "still.h"

#include <inttypes.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "config.h"
#include "log.h"
#include "pipefish/drivers/sha256.h"

typedef enum still_state { NONE = 0, WANTED, MADE, SENDING } still_state;

struct pf_still {
    pthread_mutex_t mutex;
    still_state state;
    size_t capacity, n; /* capacity 0: frames are too large */
    char refusal[112];
    uint8_t name[32];
    uint8_t bytes[];
};

bool pf_still_open(pf_still **still, uint32_t width, uint32_t height)
{
    const size_t most = PF_MSG_RAW_FRAME_MAX((size_t)width * height);
    const size_t capacity = most <= PF_STILL_MAX ? most : 0;
    pf_still *s = malloc(sizeof *s + capacity);
    if (s == NULL)
        return false;
    *s = (pf_still){.capacity = capacity};
    (void)snprintf(s->refusal, sizeof s->refusal,
                   "still: a frame of %" PRIu32 " x %" PRIu32 " is larger than the %zu MiB that can be sent at once",
                   width, height, PF_STILL_MAX >> 20);
    pthread_mutex_init(&s->mutex, NULL);
    *still = s;
    return true;
}

void pf_still_close(pf_still *s)
{
    if (s == NULL)
        return;
    pthread_mutex_destroy(&s->mutex);
    free(s);
}

/* Goes from one state to the next; false if it is in another. */
static bool step(pf_still *s, still_state from, still_state to)
{
    pthread_mutex_lock(&s->mutex);
    const bool is_there = s->state == from;
    if (is_there)
        s->state = to;
    pthread_mutex_unlock(&s->mutex);
    return is_there;
}

const char *pf_still_ask(pf_still *s)
{
    if (s->capacity == 0)
        return s->refusal;
    return step(s, NONE, WANTED) ? NULL : "still: one is under way: try again";
}

bool pf_still_next(pf_still *s, const uint8_t **bytes, size_t *n, const uint8_t **name)
{
    if (!step(s, MADE, SENDING))
        return false;
    *bytes = s->bytes;
    *n = s->n;
    *name = s->name;
    return true;
}

void pf_still_drop(pf_still *s)
{
    pthread_mutex_lock(&s->mutex);
    s->state = NONE;
    pthread_mutex_unlock(&s->mutex);
}

bool pf_still_take(pf_still *s, const pf_msg_raw_frame *frame)
{
    /* Under the mutex, or a drop and a new question could meet half a message: a millisecond for a megapixel. */
    pthread_mutex_lock(&s->mutex);
    bool is_made = s->state == WANTED;
    if (is_made) {
        pf_status status = pf_msg_encode_raw_frame(frame, s->bytes, s->capacity, &s->n);
        if (status == PF_OK)
            status = pf_sha256(s->bytes, s->n, s->name);
        is_made = status == PF_OK;
        s->state = is_made ? MADE : NONE;
        if (!is_made)
            pf_log(PF_LOG_ERROR, "still: %s", pf_status_text(status));
    }
    pthread_mutex_unlock(&s->mutex);
    return is_made;
}
