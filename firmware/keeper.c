#include "keeper.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "log.h"
#include "pipefish/camera_fixed.h"
#include "pipefish/drivers/flash_file.h"
#include "pipefish/drivers/sha256.h"
#include "pipefish/profile_store.h"

_Static_assert(PF_PROFILE_STORE_BYTES == PF_PROFILE_BINARY_MAX, "every profile fits a slot");

typedef enum job_state { JOB_NONE = 0, JOB_WAITS, JOB_DONE } job_state;

struct pf_keeper {
    pf_daemon *daemon;
    pf_flash flash;
    uint8_t scratch[PF_FLASH_FILE_PROGRAM_SIZE];
    pf_profile_store store; /* main thread only, after opening */
    uint32_t width, height; /* of the camera's frames; 0 = not known yet */
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    pf_profile profile;                                            /* what bytes hold: scratch of the main thread */
    _Alignas(16) uint8_t workspace[PF_CAMERA_FIXED_WORKSPACE_MAX]; /* of its self-test */

    pthread_mutex_t mutex; /* of all below */
    job_state job_state;
    pf_keeper_job job;
    uint8_t job_bytes[PF_PROFILE_BINARY_MAX];
    size_t job_n;
    bool has_stored; /* what the next start takes */
    pf_msg_profile stored;
    pf_keeper_texts texts; /* of the stored one, and the problem */
    uint32_t slot_erases[2];
};

static void set_problem(pf_keeper *k, const char *problem)
{
    pthread_mutex_lock(&k->mutex);
    (void)snprintf(k->texts.problem, sizeof k->texts.problem, "%s", problem);
    pthread_mutex_unlock(&k->mutex);
    if (problem[0] != '\0')
        pf_log(PF_LOG_ERROR, "camera.profile_store: %s", problem);
}

/* Whether k->bytes is a profile for this camera; `what` is in the problem's text. */
static bool check_bytes(pf_keeper *k, size_t n, const char *what)
{
    char problem[sizeof k->texts.problem];
    const char *why = NULL;
    if (!pf_daemon_read_profile(k->bytes, n, &k->profile, k->workspace, sizeof k->workspace, &why))
        (void)snprintf(problem, sizeof problem, "%s: %s", what, why);
    else if (k->width != 0 && (k->profile.camera.width != k->width || k->profile.camera.height != k->height))
        (void)snprintf(problem, sizeof problem, "%s is for %u x %u, the camera gives %u x %u", what,
                       k->profile.camera.width, k->profile.camera.height, k->width, k->height);
    else
        return true;
    set_problem(k, problem);
    return false;
}

static void log_profile(const pf_profile *profile, const char *what)
{
    const char *serial = profile->serial[0] != '\0' ? ", serial " : "";
    pf_log(PF_LOG_INFO, "profile %s%s%s%s", profile->name, serial, profile->serial, what);
}

/* Loads what counts into k->bytes and k->profile, and notes it as the stored one. False: there is none that can be
 * used, *is_trial says whether it was on trial. */
static bool load(pf_keeper *k, size_t *n, bool *is_trial)
{
    pf_status status = pf_profile_store_load(&k->store, k->bytes, sizeof k->bytes, n, is_trial);
    bool is_good = status == PF_OK && check_bytes(k, *n, "the stored profile");
    if (status != PF_OK && status != PF_ERR_END)
        set_problem(k, status == PF_ERR_CHECKSUM ? "the stored profile is damaged" : "the store cannot be read");
    pthread_mutex_lock(&k->mutex);
    k->has_stored = is_good;
    if (is_good) {
        memcpy(k->texts.name, k->profile.name, sizeof k->texts.name);
        memcpy(k->texts.serial, k->profile.serial, sizeof k->texts.serial);
        k->stored = (pf_msg_profile){.is_trial = *is_trial, .starts_left = *is_trial ? k->store.state.starts_left : 0};
        for (int i = 0; i < 4; i++)
            k->stored.crc32c |= (uint32_t)k->bytes[*n - 4 + (size_t)i] << (8 * i);
        (void)pf_sha256(k->bytes, *n, k->stored.sha256);
    }
    memcpy(k->slot_erases, k->store.state.slot_erases, sizeof k->slot_erases);
    pthread_mutex_unlock(&k->mutex);
    return is_good;
}

/* Takes the profile that counts into use; a trial that cannot be used is over. */
static void take_into_use(pf_keeper *k)
{
    pf_daemon *d = k->daemon;
    bool is_trial = false;
    size_t n = 0;
    bool is_good = load(k, &n, &is_trial);
    if (!is_good && is_trial && pf_profile_store_revert(&k->store) == PF_OK) {
        pf_log(PF_LOG_WARNING, "the profile on trial is dropped");
        is_good = load(k, &n, &is_trial);
    }
    d->has_profile = is_good;
    d->profile_size = is_good ? n : 0;
    memset(d->profile_sha256, 0, sizeof d->profile_sha256);
    if (!is_good)
        return;
    d->profile = k->profile;
    memcpy(d->profile_bytes, k->bytes, n);
    memcpy(d->profile_sha256, k->stored.sha256, sizeof d->profile_sha256);
    log_profile(&k->profile, is_trial ? ", on trial" : "");
}

/* Counts this start. What cannot be written now keeps nobody from surveying with the profile that is confirmed; one on
 * trial cannot be counted there, and might keep the daemon from starting for ever. */
static pf_status count_start(pf_keeper *k, bool can_write)
{
    pf_status status = can_write ? pf_profile_store_start(&k->store) : PF_ERR_IO;
    if (status != PF_ERR_IO)
        return status;
    set_problem(k, "the store cannot be written");
    status = pf_profile_store_open(&k->store, &k->flash, k->scratch);
    k->store.state.trial = PF_PROFILE_STORE_NONE;
    return status;
}

/* is_check: nothing is to change. PF_ERR_SPACE: there is no store, and none can be made now. */
static pf_status open_store(pf_keeper *k, bool is_check, char *error, size_t n)
{
    const char *path = k->daemon->config.camera.profile_store;
    const bool can_write = access(path, W_OK) == 0 || errno != EROFS;
    pf_flash_file_config config = {path, is_check || !can_write};
    char why[256] = "";
    pf_status status = pf_flash_file_open(&k->flash, &config, why, sizeof why);
    if (status == PF_OK) {
        status = pf_profile_store_open(&k->store, &k->flash, k->scratch);
        if (status == PF_OK && !is_check)
            status = count_start(k, can_write);
        if (status != PF_OK) {
            (void)snprintf(why, sizeof why, "%.200s: %s", path, pf_status_text(status));
            pf_flash_file_close(&k->flash);
        }
    }
    if (status != PF_OK)
        (void)snprintf(error, n, "camera.profile_store: %s", why);
    return status;
}

bool pf_keeper_open(pf_daemon *d, char *error, size_t n)
{
    pf_keeper *k = calloc(1, sizeof *k);
    if (k == NULL) {
        (void)snprintf(error, n, "camera.profile_store: no memory");
        return false;
    }
    k->daemon = d;
    pthread_mutex_init(&k->mutex, NULL);
    const pf_status status = open_store(k, false, error, n);
    if (status != PF_OK)
        free(k);
    if (status == PF_ERR_SPACE) { /* nothing was ever kept there: a survey needs none */
        pf_log(PF_LOG_ERROR, "%s; no profiles are kept until the next start", error);
        return true;
    }
    if (status != PF_OK)
        return false;
    d->keeper = k;
    take_into_use(k);
    return true;
}

bool pf_keeper_check(pf_daemon *d, uint32_t width, uint32_t height, char *error, size_t n)
{
    pf_keeper *k = calloc(1, sizeof *k);
    bool is_trial = false, is_good = true;
    size_t size = 0;
    if (k == NULL)
        return false;
    k->daemon = d;
    pf_keeper_set_size(k, width, height);
    pthread_mutex_init(&k->mutex, NULL);
    if (access(d->config.camera.profile_store, F_OK) == 0) { /* else the first start makes it */
        is_good = open_store(k, true, error, n) == PF_OK;
        if (is_good) {
            (void)load(k, &size, &is_trial);
            is_good = k->texts.problem[0] == '\0';
            if (!is_good)
                (void)snprintf(error, n, "camera.profile_store: %s", k->texts.problem);
            pf_flash_file_close(&k->flash);
        }
    }
    pthread_mutex_destroy(&k->mutex);
    free(k);
    return is_good;
}

void pf_keeper_close(pf_keeper *k)
{
    pf_flash_file_close(&k->flash);
    pthread_mutex_destroy(&k->mutex);
    free(k);
}

void pf_keeper_set_size(pf_keeper *k, uint32_t width, uint32_t height)
{
    k->width = width;
    k->height = height;
    if (k->daemon->has_profile &&
        (k->daemon->profile.camera.width != width || k->daemon->profile.camera.height != height))
        take_into_use(k);
}

void pf_keeper_reject(pf_keeper *k, const char *why)
{
    pf_daemon *d = k->daemon;
    bool is_trial = k->stored.is_trial;
    char problem[sizeof k->texts.problem];
    (void)snprintf(problem, sizeof problem, "the stored profile: %.150s", why);
    set_problem(k, problem);
    if (is_trial && pf_profile_store_revert(&k->store) == PF_OK) {
        pf_log(PF_LOG_WARNING, "the profile on trial is dropped");
        take_into_use(k);
        return;
    }
    d->has_profile = false;
    d->profile_size = 0;
    memset(d->profile_sha256, 0, sizeof d->profile_sha256);
    pf_log(PF_LOG_WARNING, "no profile is used: no prediction, no parallax");
}

/* ---- jobs */

static bool is_stored(const pf_keeper *k, const uint8_t sha256[32])
{
    return k->has_stored && memcmp(k->stored.sha256, sha256, 32) == 0;
}

/* After an error the state on the disk may be the old or the new one. */
static bool fail_store(pf_keeper *k, pf_status status)
{
    (void)pf_profile_store_open(&k->store, &k->flash, k->scratch);
    set_problem(k, status == PF_ERR_IO ? "the store cannot be written" : pf_status_text(status));
    return false;
}

static bool store_profile(pf_keeper *k, const pf_keeper_job *job)
{
    bool is_trial = false;
    size_t n = 0;
    if (is_stored(k, job->sha256)) /* the host did not hear our answer, or says it again */
        return true;
    memcpy(k->bytes, k->job_bytes, k->job_n);
    if (!check_bytes(k, k->job_n, "the profile"))
        return false;
    pf_status status =
        pf_profile_store_write(&k->store, k->job_bytes, k->job_n, (uint8_t)k->daemon->config.camera.trial_starts);
    if (status != PF_OK)
        return fail_store(k, status);
    if (!load(k, &n, &is_trial))
        return false;
    if (!is_trial || !is_stored(k, job->sha256)) {
        set_problem(k, "the profile reads back otherwise");
        return false;
    }
    log_profile(&k->profile, ": stored, on trial");
    return true;
}

static bool confirm_profile(pf_keeper *k, const pf_keeper_job *job)
{
    bool is_trial = false;
    size_t n = 0;
    if (!is_stored(k, job->sha256)) {
        set_problem(k, "another profile is stored than the one to be confirmed");
        return false;
    }
    if (!k->stored.is_trial)
        return true;
    /* Jobs are done while a survey runs: what is in use then has come through a start and the pipeline's opening. */
    if (!k->daemon->has_profile || memcmp(k->daemon->profile_sha256, job->sha256, 32) != 0) {
        set_problem(k, "the profile on trial is not in use yet: restart the device, then confirm");
        return false;
    }
    pf_status status = pf_profile_store_confirm(&k->store);
    if (status != PF_OK)
        return fail_store(k, status);
    pf_log(PF_LOG_INFO, "the profile is confirmed");
    return load(k, &n, &is_trial);
}

static bool revert_profile(pf_keeper *k)
{
    bool is_trial = false;
    size_t n = 0;
    pf_status status = pf_profile_store_revert(&k->store);
    if (status == PF_ERR_END) {
        set_problem(k, "there is no profile to go back to");
        return false;
    }
    if (status == PF_ERR_CHECKSUM) {
        set_problem(k, "the profile before this one is damaged");
        return false;
    }
    if (status != PF_OK)
        return fail_store(k, status);
    pf_log(PF_LOG_INFO, "back to the profile before");
    (void)load(k, &n, &is_trial); /* none at all is an answer too */
    return true;
}

void pf_keeper_work(pf_keeper *k)
{
    uint64_t one = 1;
    pthread_mutex_lock(&k->mutex);
    bool has_job = k->job_state == JOB_WAITS;
    pf_keeper_job job = k->job; /* its bytes stay as they are until it is done */
    pthread_mutex_unlock(&k->mutex);
    if (!has_job)
        return;
    bool is_done = false;
    set_problem(k, "");
    switch (job.what) {
    case PF_KEEPER_STORE:
        is_done = store_profile(k, &job);
        break;
    case PF_KEEPER_CONFIRM:
        is_done = confirm_profile(k, &job);
        break;
    case PF_KEEPER_REVERT:
        is_done = revert_profile(k);
        break;
    }
    pthread_mutex_lock(&k->mutex);
    k->job.has_failed = !is_done;
    k->job_state = JOB_DONE;
    pthread_mutex_unlock(&k->mutex);
    if (write(k->daemon->wake_fd, &one, sizeof one) < 0)
        pf_log(PF_LOG_ERROR, "cannot wake the courier");
}

bool pf_keeper_ask(pf_keeper *k, const pf_keeper_job *job, const uint8_t *bytes, size_t n)
{
    pthread_mutex_lock(&k->mutex);
    bool is_free = k->job_state == JOB_NONE;
    if (is_free) {
        k->job = *job;
        k->job_n = n;
        if (n > 0)
            memcpy(k->job_bytes, bytes, n);
        k->job_state = JOB_WAITS;
    }
    pthread_mutex_unlock(&k->mutex);
    return is_free;
}

bool pf_keeper_done(pf_keeper *k, pf_keeper_job *job)
{
    pthread_mutex_lock(&k->mutex);
    bool is_done = k->job_state == JOB_DONE;
    if (is_done) {
        *job = k->job;
        k->job_state = JOB_NONE;
    }
    pthread_mutex_unlock(&k->mutex);
    return is_done;
}

void pf_keeper_state(pf_keeper *k, pf_msg_profile_state *state, pf_keeper_texts *texts)
{
    pthread_mutex_lock(&k->mutex);
    *texts = k->texts;
    *state = (pf_msg_profile_state){.has_in_use = k->daemon->has_profile,
                                    .has_stored = k->has_stored,
                                    .stored = k->stored,
                                    .problem = texts->problem,
                                    .slot_erases = {k->slot_erases[0], k->slot_erases[1]}};
    pthread_mutex_unlock(&k->mutex);
    state->stored.name = texts->name;
    state->stored.serial = texts->serial;
    if (k->daemon->has_profile)
        state->in_use = pf_daemon_profile(k->daemon);
}

bool pf_keeper_trial(pf_keeper *k, const uint8_t sha256[32], uint32_t *starts_left)
{
    pthread_mutex_lock(&k->mutex);
    bool is_trial = is_stored(k, sha256) && k->stored.is_trial;
    *starts_left = is_trial ? k->stored.starts_left : 0;
    pthread_mutex_unlock(&k->mutex);
    return is_trial;
}
