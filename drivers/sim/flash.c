/* Emulated flash memory. `bytes` is what reads see. What a reordered cut needs is `durable`, the content at the last
 * flush, and the operations since then with their data; the data of a program are still in `bytes` unless it was erased
 * again, which the log therefore keeps by flushing first. */
#include "pipefish/drivers/sim_flash.h"

#include <string.h>

typedef struct operation {
    uint32_t at, n;
    bool is_erase;
} operation;

struct pf_sim_flash {
    pf_sim_flash_config config;
    pf_sim_flash_stats stats;
    uint32_t size;
    uint64_t random;
    uint64_t left;     /* operations until the cut; UINT64_MAX = none */
    uint64_t spoil_at; /* stats.operations from which on the next program goes wrong; UINT64_MAX = none */
    uint32_t kind;
    bool is_off, is_broken;
    uint32_t broken;  /* sector */
    uint32_t pending; /* operations since the last flush */
    operation log[PF_SIM_FLASH_CACHE];
    uint64_t touched[4]; /* by them: sectors modulo 256, a bit each */
    uint8_t *bytes, *durable;
    uint32_t *erases;
};

/* SplitMix64 (Steele, Lea and Flood 2014). */
static uint64_t draw(pf_sim_flash *s)
{
    uint64_t z = s->random += 0x9E3779B97F4A7C15u;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9u;
    z = (z ^ z >> 27) * 0x94D049BB133111EBu;
    return z ^ z >> 31;
}

static uint32_t below(pf_sim_flash *s, uint32_t n)
{
    return (uint32_t)(draw(s) % n);
}

static void fill_noise(pf_sim_flash *s, uint8_t *p, uint32_t n)
{
    for (uint32_t i = 0; i < n; i++)
        p[i] = (uint8_t)draw(s);
}

static void forget_pending(pf_sim_flash *s)
{
    s->pending = 0;
    memset(s->touched, 0, sizeof s->touched);
}

static void make_durable(pf_sim_flash *s)
{
    for (uint32_t i = 0; i < s->pending; i++)
        memcpy(s->durable + s->log[i].at, s->bytes + s->log[i].at, s->log[i].n);
    forget_pending(s);
}

/* Notes an operation, which reaches the medium with the next flush at the latest. */
static void keep(pf_sim_flash *s, const operation *o)
{
    const uint32_t sector = o->at / s->config.erase_size % 256;
    s->log[s->pending++] = *o;
    s->touched[sector / 64] |= UINT64_C(1) << sector % 64;
}

static bool is_pending(const pf_sim_flash *s, uint32_t sector)
{
    if (!(s->touched[sector % 256 / 64] >> sector % 64 & 1))
        return false;
    for (uint32_t i = 0; i < s->pending; i++)
        if (s->log[i].at / s->config.erase_size == sector)
            return true;
    return false;
}

/* What part of an operation does to the first n bytes of its range, and to some bits of the next one. */
static void tear(pf_sim_flash *s, const operation *o, const uint8_t *data)
{
    uint32_t n = below(s, o->n + 1);
    uint8_t *p = s->bytes + o->at;
    if (o->is_erase) {
        memset(p, 0xFF, n);
        for (uint32_t i = n; i < o->n; i++)
            p[i] |= (uint8_t)draw(s);
    } else {
        for (uint32_t i = 0; i < n; i++)
            p[i] &= data[i];
        if (n < o->n)
            p[n] &= (uint8_t)(data[n] | (uint8_t)draw(s));
    }
}

/* Applies any of the operations since the last flush, and `last`, to what was flushed, in any order. A program that
 * lands where an erase has not cleared leaves the bits that both have. */
static void reorder(pf_sim_flash *s, const operation *last, const uint8_t *data)
{
    uint32_t order[PF_SIM_FLASH_CACHE + 1], n = s->pending + (last->n > 0);
    for (uint32_t i = 0; i < n; i++) {
        uint32_t j = below(s, i + 1);
        order[i] = order[j];
        order[j] = i;
    }
    for (uint32_t i = 0; i < n; i++) {
        bool is_last = order[i] == s->pending;
        const operation *o = is_last ? last : &s->log[order[i]];
        const uint8_t *value = is_last && !o->is_erase ? data : s->bytes + o->at;
        if (draw(s) % 2 == 0)
            continue;
        for (uint32_t j = 0; j < o->n; j++)
            s->durable[o->at + j] = o->is_erase ? 0xFF : s->durable[o->at + j] & value[j];
    }
    for (uint32_t i = 0; i < s->pending; i++)
        memcpy(s->bytes + s->log[i].at, s->durable + s->log[i].at, s->log[i].n);
    memcpy(s->bytes + last->at, s->durable + last->at, last->n);
    forget_pending(s);
}

/* The operation at which power fails; a flush has n = 0. */
static void cut(pf_sim_flash *s, const operation *o, const uint8_t *data)
{
    s->is_off = true;
    if (s->kind == PF_SIM_CUT_REORDERED) {
        reorder(s, o, data);
        return;
    }
    if (s->kind == PF_SIM_CUT_TORN && o->n > 0)
        tear(s, o, data);
    if (s->kind == PF_SIM_CUT_TAIL && o->n > 0) {
        uint32_t n = below(s, o->n);
        if (o->is_erase)
            memset(s->bytes + o->at, 0xFF, n);
        else
            memcpy(s->bytes + o->at, data, n);
        fill_noise(s, s->bytes + o->at + n, o->n - n);
    }
    make_durable(s);
    memcpy(s->durable + o->at, s->bytes + o->at, o->n);
}

/* Counts an operation. False: power is off, or fails now. */
static bool begin(pf_sim_flash *s, const operation *o, const uint8_t *data)
{
    s->stats.operations++;
    if (s->is_off)
        return false;
    if (s->left == 0) {
        cut(s, o, data);
        return false;
    }
    if (s->left != UINT64_MAX)
        s->left--;
    return true;
}

static bool is_bad(const pf_sim_flash *s, uint32_t at)
{
    return s->is_broken && at / s->config.erase_size == s->broken;
}

static pf_status sim_read(void *self, uint32_t at, void *bytes, uint32_t n)
{
    pf_sim_flash *s = self;
    if (s->is_off)
        return PF_ERR_IO;
    if (at > s->size || n > s->size - at) {
        s->stats.violations++;
        return PF_ERR_IO;
    }
    memcpy(bytes, s->bytes + at, n);
    return PF_OK;
}

static bool is_programmable(const pf_sim_flash *s, uint32_t at, uint32_t n)
{
    uint32_t unit = s->config.program_size, sector = s->config.erase_size;
    if (n == 0 || at % unit != 0 || n % unit != 0 || at >= s->size || n > sector - at % sector)
        return false;
    for (uint32_t i = 0; i < n; i++)
        if (s->bytes[at + i] != 0xFF)
            return false;
    return true;
}

static pf_status sim_program(void *self, uint32_t at, const void *bytes, uint32_t n)
{
    pf_sim_flash *s = self;
    operation o = {at, n, false};
    if (!s->is_off && !is_programmable(s, at, n)) {
        s->stats.violations++;
        return PF_ERR_IO;
    }
    if (!begin(s, &o, bytes) || is_bad(s, at))
        return PF_ERR_IO;
    if (s->pending == PF_SIM_FLASH_CACHE)
        make_durable(s);
    memcpy(s->bytes + at, bytes, n);
    if (s->stats.operations > s->spoil_at) {
        s->bytes[at + below(s, n)] ^= (uint8_t)(1u << below(s, 8));
        s->spoil_at = UINT64_MAX;
    }
    keep(s, &o);
    s->stats.programs++;
    return PF_OK;
}

static pf_status sim_erase(void *self, uint32_t sector)
{
    pf_sim_flash *s = self;
    operation o = {sector * s->config.erase_size, s->config.erase_size, true};
    if (sector >= s->config.sectors) {
        s->stats.violations++;
        return PF_ERR_IO;
    }
    if (!begin(s, &o, NULL) || is_bad(s, o.at))
        return PF_ERR_IO;
    if (s->pending == PF_SIM_FLASH_CACHE || is_pending(s, sector)) /* see the top */
        make_durable(s);
    memset(s->bytes + o.at, 0xFF, o.n);
    keep(s, &o);
    s->stats.erases++;
    if (++s->erases[sector] > s->stats.most_erases)
        s->stats.most_erases = s->erases[sector];
    return PF_OK;
}

static pf_status sim_flush(void *self)
{
    pf_sim_flash *s = self;
    operation o = {0, 0, false};
    if (!begin(s, &o, NULL))
        return PF_ERR_IO;
    make_durable(s);
    s->stats.flushes++;
    return PF_OK;
}

/* -------------------------------------------------------------------------------------------------- handling */

static size_t round_up(size_t n)
{
    return (n + 15) / 16 * 16;
}

size_t pf_sim_flash_workspace_size(const pf_sim_flash_config *c)
{
    uint64_t size = (uint64_t)c->erase_size * c->sectors;
    if (c->program_size < 1 || c->erase_size < 1 || c->sectors < 1 || c->erase_size % c->program_size != 0 ||
        size > 64u << 20)
        return 0;
    return round_up(sizeof(pf_sim_flash)) + 2 * round_up((size_t)size) + sizeof(uint32_t) * c->sectors;
}

void pf_sim_flash_seed(pf_sim_flash *s, uint64_t seed)
{
    s->random = seed;
}

pf_status pf_sim_flash_init(pf_sim_flash **sim, pf_flash *flash, const pf_sim_flash_config *config, void *workspace,
                            size_t size)
{
    static const pf_flash_ops ops = {sim_read, sim_program, sim_erase, sim_flush};
    size_t needed = pf_sim_flash_workspace_size(config);
    if (needed == 0 || !workspace || size < needed)
        return PF_ERR_ARGUMENT;
    pf_sim_flash *s = workspace;
    memset(s, 0, sizeof *s);
    s->config = *config;
    s->size = config->erase_size * config->sectors;
    s->bytes = (uint8_t *)workspace + round_up(sizeof *s);
    s->durable = s->bytes + round_up(s->size);
    s->erases = (uint32_t *)(void *)(s->durable + round_up(s->size));
    s->random = config->seed;
    s->left = s->spoil_at = UINT64_MAX;
    if (config->starts_dirty)
        fill_noise(s, s->bytes, s->size);
    else
        memset(s->bytes, 0xFF, s->size);
    memcpy(s->durable, s->bytes, s->size);
    memset(s->erases, 0, sizeof *s->erases * config->sectors);
    *sim = s;
    *flash = (pf_flash){s, &ops, config->erase_size, config->program_size, config->sectors};
    return PF_OK;
}

void pf_sim_flash_cut_after(pf_sim_flash *s, uint64_t operations, pf_sim_cut kind)
{
    s->left = operations;
    s->kind = kind;
}

bool pf_sim_flash_is_off(const pf_sim_flash *s)
{
    return s->is_off;
}

void pf_sim_flash_power_on(pf_sim_flash *s)
{
    s->is_off = false;
    s->left = s->spoil_at = UINT64_MAX;
}

void pf_sim_flash_spoil_after(pf_sim_flash *s, uint64_t operations)
{
    s->spoil_at = s->stats.operations + operations;
}

void pf_sim_flash_break(pf_sim_flash *s, uint32_t sector)
{
    s->is_broken = true;
    s->broken = sector;
}

void pf_sim_flash_flip(pf_sim_flash *s, uint64_t bit)
{
    s->bytes[bit / 8] ^= (uint8_t)(1u << bit % 8);
    s->durable[bit / 8] ^= (uint8_t)(1u << bit % 8);
}

const pf_sim_flash_stats *pf_sim_flash_get_stats(const pf_sim_flash *s)
{
    return &s->stats;
}

uint32_t pf_sim_flash_erases(const pf_sim_flash *s, uint32_t sector)
{
    return s->erases[sector];
}

void pf_sim_flash_copy(pf_sim_flash *to, const pf_sim_flash *from)
{
    pf_sim_flash kept = *to;
    *to = *from;
    to->bytes = kept.bytes;
    to->durable = kept.durable;
    to->erases = kept.erases;
    memcpy(to->bytes, from->bytes, from->size);
    memcpy(to->durable, from->durable, from->size);
    memcpy(to->erases, from->erases, sizeof *from->erases * from->config.sectors);
}
