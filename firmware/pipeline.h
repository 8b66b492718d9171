/* The capture thread: camera -> tracker -> keyframe choice -> JPEG -> message -> store. With daemon.threads = 2 a
 * worker tracks while this thread takes the next frame and makes the last one's keyframe; nothing else of the daemon
 * can stall either.
 */
#ifndef PIPEFISHD_PIPELINE_H
#define PIPEFISHD_PIPELINE_H

#include "courier.h"

typedef struct pf_pipeline pf_pipeline;

/* Whether all that depends on the settings, the camera and the profile opens; it is closed again. False: error[n]. */
bool pf_pipeline_can_open(pf_daemon *daemon, char *error, size_t n);

/* Takes all memory; hands the store the SurveyEnd of an interrupted survey (`before`, if it has had boots) and the
 * SurveyStart. False: error[n] says what failed. */
bool pf_pipeline_open(pf_pipeline **pipeline, pf_daemon *daemon, pf_courier *courier, const pf_survey *survey,
                      const pf_survey *before, char *error, size_t n);

/* Starts the thread: captures until the recording ends, the camera fails or the daemon is stopped, then stores the
 * SurveyEnd and sets is_done. */
bool pf_pipeline_start(pf_pipeline *pipeline, char *error, size_t n);
bool pf_pipeline_is_done(pf_pipeline *pipeline);

/* Joins the thread and frees all; the survey must have been stopped or over, and pf_store_flush been called, lest it
 * wait for a host. False: the camera failed. */
bool pf_pipeline_close(pf_pipeline *pipeline);

#endif
