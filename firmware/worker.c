#include "worker.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>

#include "pulse.h"

struct pf_worker {
    pthread_t thread;
    pthread_mutex_t mutex;
    pthread_cond_t change; /* of item or is_over */
    void (*work)(void *user, void *item);
    void *user;
    void *item; /* under way; NULL = none */
    bool is_over;
};

static void *run(void *argument)
{
    pf_worker *w = argument;
    pf_pulse_begin(PF_PULSE_TRACKING);
    pthread_mutex_lock(&w->mutex);
    for (;;) {
        pf_pulse_rest();
        while (w->item == NULL && !w->is_over)
            pthread_cond_wait(&w->change, &w->mutex);
        pf_pulse_work();
        if (w->item == NULL)
            break;
        pthread_mutex_unlock(&w->mutex);
        w->work(w->user, w->item);
        pthread_mutex_lock(&w->mutex);
        w->item = NULL;
        pthread_cond_broadcast(&w->change);
    }
    pthread_mutex_unlock(&w->mutex);
    pf_pulse_rest();
    return NULL;
}

bool pf_worker_open(pf_worker **worker, void (*work)(void *user, void *item), void *user, char *error, size_t n)
{
    pf_worker *w = calloc(1, sizeof *w);
    if (w != NULL) {
        (void)pthread_mutex_init(&w->mutex, NULL);
        (void)pthread_cond_init(&w->change, NULL);
        w->work = work;
        w->user = user;
        if (pthread_create(&w->thread, NULL, run, w) == 0) {
            *worker = w;
            return true;
        }
        (void)pthread_cond_destroy(&w->change);
        (void)pthread_mutex_destroy(&w->mutex);
        free(w);
    }
    (void)snprintf(error, n, "cannot start the tracking thread");
    return false;
}

void pf_worker_give(pf_worker *w, void *item)
{
    pthread_mutex_lock(&w->mutex);
    w->item = item;
    pthread_cond_broadcast(&w->change);
    pthread_mutex_unlock(&w->mutex);
}

void pf_worker_wait(pf_worker *w)
{
    pthread_mutex_lock(&w->mutex);
    while (w->item != NULL)
        pthread_cond_wait(&w->change, &w->mutex);
    pthread_mutex_unlock(&w->mutex);
}

void pf_worker_close(pf_worker *w)
{
    if (w == NULL)
        return;
    pf_worker_wait(w);
    pthread_mutex_lock(&w->mutex);
    w->is_over = true;
    pthread_cond_broadcast(&w->change);
    pthread_mutex_unlock(&w->mutex);
    (void)pthread_join(w->thread, NULL);
    (void)pthread_cond_destroy(&w->change);
    (void)pthread_mutex_destroy(&w->mutex);
    free(w);
}
