/* The objects that a survey consists of for the host: a start of each boot, keyframes, an end. Made here, given to the
 * store.
 */
#ifndef PIPEFISHD_OBJECTS_H
#define PIPEFISHD_OBJECTS_H

#include "pipefish/drivers/jpeg.h"
#include "survey.h"
#include "tracking.h"

/* Most bytes of an object with this configuration and camera: what the store's jobs must hold. */
size_t pf_object_max(const pf_daemon *daemon);

/* The survey's start: every boot has one. False: error[n]. */
bool pf_object_start(pf_daemon *daemon, char *error, size_t n);

/* The end of a survey that had none when another began. False: error[n]. */
bool pf_object_interrupted(pf_daemon *daemon, const pf_survey *before, char *error, size_t n);

/* Keyframe `index`, of a tracked frame. break_reason[PF_BREAK_REASON_MAX]: "" = tracks go on. False: it is lost, and
 * the log says why. */
bool pf_object_keyframe(pf_daemon *daemon, pf_jpeg *jpeg, const pf_shot *shot, uint32_t index,
                        const char *break_reason);

/* The survey's end, after all its keyframes; returns when it is stored, or cannot be. `reason` is UTF-8. */
void pf_object_end(pf_daemon *daemon, uint32_t keyframes, uint32_t boots, const char *reason);

#endif
