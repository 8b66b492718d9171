/* The spool: what must not be lost until the host says that it has it. Survives power cuts and kill -9. */
#ifndef PIPEFISH_DRIVERS_SPOOL_H
#define PIPEFISH_DRIVERS_SPOOL_H

#include "pipefish/base.h"

typedef struct pf_spool {
    void *self;
    const struct pf_spool_ops *ops;
} pf_spool;

typedef struct pf_spool_item {
    uint64_t row;     /* order of storing; what remove() takes */
    uint32_t kind;    /* pf_object_kind */
    uint8_t name[32]; /* SHA-256 of the bytes */
    uint32_t size;
} pf_spool_item;

typedef struct pf_spool_stats {
    uint64_t objects, bytes;                        /* waiting now */
    uint64_t stored, acknowledged, evicted, errors; /* since opening */
    uint64_t healed; /* times that a damaged file was set aside, or one from before was read on; healing() tells */
} pf_spool_stats;

/* Of an object that may have to make room for others; those stored without one never have to. */
typedef struct pf_spool_rank {
    uint32_t importance; /* the least important go first, of equals the oldest */
    uint32_t number;     /* the caller's own name for it */
} pf_spool_rank;

typedef struct pf_spool_victim {
    uint64_t row;
    uint32_t number;
    uint32_t size;
} pf_spool_victim;

#define PF_SPOOL_VICTIMS_MAX 32u

typedef struct pf_spool_ops {
    /* Stores durably: on PF_OK the object outlives a power cut. The same name twice is stored once (PF_OK).
     * PF_ERR_SPACE (quota or disk full, or the medium read-only: later it may fit), PF_ERR_IO, PF_ERR_ARGUMENT (no
     * bytes, or more than the quota: never). */
    pf_status (*put)(void *self, uint32_t kind, const uint8_t name[32], const void *bytes, size_t n);

    /* The first item with row > after, oldest first. PF_OK, PF_ERR_END (no more), PF_ERR_IO. */
    pf_status (*next)(void *self, uint64_t after, pf_spool_item *item);

    /* Reads the bytes of an item, as next() gave it, into the caller's buffer. PF_OK, PF_ERR_SPACE, PF_ERR_END (gone),
     * PF_ERR_IO, PF_ERR_CHECKSUM (the medium has damaged it, or its place: bytes are what it gives). */
    pf_status (*read)(void *self, const pf_spool_item *item, void *bytes, size_t capacity, size_t *n);

    /* Removes what the host has acknowledged. PF_OK (also if it is gone already), PF_ERR_IO. */
    pf_status (*remove)(void *self, uint64_t row);

    /* Small durable values that belong to the survey (its id, counters). get: PF_OK, PF_ERR_END (no such key).
     * set with n = 0 deletes. put_and_set stores an object and a value in one transaction. */
    pf_status (*get)(void *self, const char *key, void *bytes, size_t capacity, size_t *n);
    pf_status (*set)(void *self, const char *key, const void *bytes, size_t n);
    pf_status (*put_and_set)(void *self, uint32_t kind, const uint8_t name[32], const void *bytes, size_t n,
                             const char *key, const void *value, size_t value_n);

    /* What would have to go so that at least n bytes become free, and on a disk that is full also room for n bytes in
     * the file as it is: of the objects with a rank after row `after`, none more important than `importance`. PF_OK;
     * PF_ERR_SPACE (all of them, or as many as fit into victims, are not enough); PF_ERR_IO. */
    pf_status (*victims)(void *self, uint64_t after, uint32_t importance, size_t n,
                         pf_spool_victim victims[PF_SPOOL_VICTIMS_MAX], uint32_t *count);

    /* As put_and_set; in the same transaction the victims go. rank: NULL = the object never has to. */
    pf_status (*exchange)(void *self, const pf_spool_victim *victims, uint32_t count, uint32_t kind,
                          const uint8_t name[32], const void *bytes, size_t n, const pf_spool_rank *rank,
                          const char *key, const void *value, size_t value_n);

    /* Takes the ranks of all objects away: nothing that is stored now has to go any more. PF_OK, PF_ERR_SPACE,
     * PF_ERR_IO. */
    pf_status (*keep_all)(void *self);

    void (*stats)(void *self, pf_spool_stats *stats);
    const char *(*error)(void *self);   /* last failure in words; valid until this thread asks again */
    const char *(*healing)(void *self); /* likewise: what came of the last damaged file; "" = there was none */
    void (*close)(void *self);
} pf_spool_ops;

typedef struct pf_spool_config {
    const char *path;    /* SQLite file; its folder must exist */
    uint64_t quota;      /* most bytes of objects; 0 = no limit */
    void (*alive)(void); /* called now and then by what takes long: opening a large file, reading a damaged one. NULL:
                            nobody asks */
} pf_spool_config;

/* Opens or creates. A spool whose file is damaged, now or while it is in use, is set aside as <path>.damaged-N, and a
 * new one begun with every object that can still be read: under its row, but never to make room for others. What a
 * kill, or a new file that is full, keeps from that is done at the next opening. Anybody else's file is refused. A
 * medium that is read-only, or too full for an empty spool, gives what is there, takes and removes nothing, and is
 * asked at each call, a full one once a second, whether it still is. All calls may come from any thread. PF_OK,
 * PF_ERR_IO, PF_ERR_FORMAT (not a spool), PF_ERR_VERSION.
 */
pf_status pf_spool_open(pf_spool *spool, const pf_spool_config *config, char *error, size_t n);

#endif
