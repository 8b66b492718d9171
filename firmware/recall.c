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
    char text[96];
    int n = snprintf(text, sizeof text, "%u %s\n", r->starts, r->hash);
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

void pf_recall_begin(pf_recall *recall, const char *folder, const char *file)
{
    char path[PATH_BYTES], hash[65] = "";
    unsigned starts = 0;
    memset(recall, 0, sizeof *recall);
    if (folder == NULL || folder[0] == '\0' || strlen(folder) >= sizeof recall->folder ||
        !hash_file(file, recall->hash))
        return;
    (void)strcpy(recall->folder, folder);
    if (mkdir(folder, 0755) != 0 && errno != EEXIST) {
        pf_log(PF_LOG_WARNING, "--state %s: %s", folder, strerror(errno));
        recall->folder[0] = '\0';
        return;
    }
    path_of(recall, "starts", path);
    FILE *in = fopen(path, "rbe");
    if (in != NULL) {
        bool is_same = fscanf(in, "%9u %64s", &starts, hash) == 2 && strcmp(hash, recall->hash) == 0;
        recall->starts = is_same ? starts : 0; /* other settings have their own tries */
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

void pf_recall_good(pf_recall *recall, const pf_config *config)
{
    size_t size = pf_config_keys() * (PF_CONFIG_LINE_MAX + 32), at = 0;
    if (recall->folder[0] == '\0' || recall->is_done)
        return;
    recall->is_done = true;
    if (recall->is_recalled) /* until the file is changed: that it failed three times stays true */
        return;
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
    recall->starts = 0;
    keep_starts(recall);
}
