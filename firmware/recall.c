#include "recall.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "log.h"
#include "pipefish/drivers/file.h"
#include "pipefish/drivers/sha256.h"

#define PATH_BYTES 1024
#define FILE_MAX   ((size_t)1 << 20) /* as pf_config_load */

static void path_of(const pf_recall *r, const char *name, char path[PATH_BYTES])
{
    (void)snprintf(path, PATH_BYTES, "%s/%s", r->folder, name);
}

static void keep(const pf_recall *r, const char *name, const char *text, size_t n)
{
    char path[PATH_BYTES], error[PATH_BYTES + 128];
    path_of(r, name, path);
    if (pf_file_replace(path, text, n, error, sizeof error) != PF_OK)
        pf_log(PF_LOG_WARNING, "%s", error);
}

static void keep_starts(const pf_recall *r)
{
    char text[160];
    int n = snprintf(text, sizeof text, "%u %s %s%s\n", r->starts, r->hash, r->boot, r->is_up ? " up" : "");
    keep(r, "starts", text, (size_t)n);
}

/* A file that cannot be read has a hash too: that of no bytes. */
static bool hash_file(const char *file, char hash[65])
{
    uint8_t sha256[32];
    char *text = malloc(FILE_MAX);
    FILE *in = fopen(file, "rbe");
    size_t n = text != NULL && in != NULL ? fread(text, 1, FILE_MAX, in) : 0;
    bool ok = pf_sha256(n > 0 ? text : "", n, sha256) == PF_OK;
    if (in != NULL)
        (void)fclose(in);
    free(text);
    for (size_t i = 0; ok && i < sizeof sha256; i++)
        (void)snprintf(hash + 2 * i, 3, "%02x", sha256[i]);
    return ok;
}

/* Another for each start of the kernel. */
static void read_boot(char boot[40])
{
    FILE *in = fopen("/proc/sys/kernel/random/boot_id", "re");
    if (in == NULL || fscanf(in, "%36s", boot) != 1)
        (void)strcpy(boot, "-");
    if (in != NULL)
        (void)fclose(in);
}

/* Starts in a row that failed, before this one. */
static unsigned failed_before(const pf_recall *r, FILE *in)
{
    char hash[65] = "", boot[40] = "", state[8] = "";
    unsigned starts = 0;
    int fields = fscanf(in, "%9u %64s %36s %7s", &starts, hash, boot, state);
    if (fields < 2 || strcmp(hash, r->hash) != 0) /* other settings have their own tries */
        return 0;
    bool was_cut = fields == 4 && strcmp(state, "up") == 0 && strcmp(boot, r->boot) != 0;
    return was_cut && starts > 0 ? starts - 1 : starts;
}

void pf_recall_begin(pf_recall *recall, const char *folder, const char *file)
{
    char path[PATH_BYTES];
    memset(recall, 0, sizeof *recall);
    if (folder == NULL || folder[0] == '\0' || strlen(folder) >= sizeof recall->folder ||
        !hash_file(file, recall->hash))
        return;
    (void)strcpy(recall->folder, folder);
    (void)pthread_mutex_init(&recall->mutex, NULL);
    if (mkdir(folder, 0755) != 0 && errno != EEXIST) {
        pf_log(PF_LOG_WARNING, "--state %s: %s", folder, strerror(errno));
        recall->folder[0] = '\0';
        return;
    }
    read_boot(recall->boot);
    path_of(recall, "starts", path);
    FILE *in = fopen(path, "rbe");
    if (in != NULL) {
        recall->starts = failed_before(recall, in);
        (void)fclose(in);
    }
    path_of(recall, "good.ini", path);
    recall->has_good = access(path, R_OK) == 0;
    if (recall->starts <= PF_RECALL_STARTS)
        recall->starts++;
    keep_starts(recall);
}

bool pf_recall_is_due(const pf_recall *recall, char *path, size_t n)
{
    if (!recall->has_good || recall->starts <= PF_RECALL_STARTS)
        return false;
    (void)snprintf(path, n, "%s/good.ini", recall->folder);
    return true;
}

void pf_recall_up(pf_recall *recall, bool is_well)
{
    if (recall->folder[0] == '\0')
        return;
    pthread_mutex_lock(&recall->mutex);
    if (!recall->is_done && recall->is_up != is_well) {
        recall->is_up = is_well;
        keep_starts(recall);
    }
    pthread_mutex_unlock(&recall->mutex);
}

/* From now on whatever happens to this start is no failure. */
static void end_trial(pf_recall *recall)
{
    pthread_mutex_lock(&recall->mutex);
    recall->is_done = true;
    if (!recall->is_recalled) { /* else it stays true that the file failed three times, until it is changed */
        recall->starts = 0;
        keep_starts(recall);
    }
    pthread_mutex_unlock(&recall->mutex);
}

static void keep_good(const pf_recall *recall, const pf_config *config)
{
    size_t size = pf_config_keys() * (PF_CONFIG_LINE_MAX + 32), at = 0;
    char *text = malloc(size), section[64] = "";
    if (text == NULL)
        return;
    for (uint32_t i = 0; i < pf_config_keys(); i++) {
        char line[PF_CONFIG_LINE_MAX];
        (void)pf_config_line(config, i, line, sizeof line);
        const char *dot = strchr(line, '.'), *equals = strstr(dot, " = ");
        if (strncmp(line, section, (size_t)(dot - line)) != 0 || section[dot - line] != '\0') {
            (void)snprintf(section, sizeof section, "%.*s", (int)(dot - line), line);
            at += (size_t)snprintf(text + at, size - at, "[%s]\n", section);
        }
        const char *quote = strchr(equals + 3, '"') == NULL ? "\"" : "";
        at += (size_t)snprintf(text + at, size - at, "%.*s = %s%s%s\n", (int)(equals - dot - 1), dot + 1, quote,
                               equals + 3, quote);
    }
    keep(recall, "good.ini", text, at);
    free(text);
}

void pf_recall_good(pf_recall *recall, const pf_config *config)
{
    if (recall->folder[0] == '\0' || recall->is_done)
        return;
    if (!recall->is_recalled)
        keep_good(recall, config);
    end_trial(recall);
}
