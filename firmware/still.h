/* The still: one frame as the camera gave it, for a host that asks, in memory taken at start-up. The link thread asks
 * and sends, the capture thread fills; neither waits for the other.
 */
#ifndef PIPEFISHD_STILL_H
#define PIPEFISHD_STILL_H

#include <stdbool.h>
#include <stddef.h>

#include "pipefish/messages.h"

typedef struct pf_still pf_still;

/* Bytes of a message: as many as hosts take in one object. */
#define PF_STILL_MAX ((size_t)32 << 20)

/* Memory for a frame of so many pixels; none is taken where its message would be larger than PF_STILL_MAX, and then
 * every question is refused. False: there is no memory. */
bool pf_still_open(pf_still **still, uint32_t width, uint32_t height);
void pf_still_close(pf_still *still); /* NULL is allowed */

/* ---- the link thread */

/* Wants the next frame. NULL, or why there will be none, for the host: one is under way ("... try again"), or frames
 * are too large. */
const char *pf_still_ask(pf_still *still);

/* A message to be sent: its bytes and SHA-256 stay as they are until pf_still_drop. False: there is none (yet), or it
 * has been returned before. */
bool pf_still_next(pf_still *still, const uint8_t **bytes, size_t *n, const uint8_t **name);

/* Forgets what was asked, made or being sent. */
void pf_still_drop(pf_still *still);

/* ---- the capture thread */

/* Makes the message if one is wanted. True: there is one now. */
bool pf_still_take(pf_still *still, const pf_msg_raw_frame *frame);

#endif
