#include "spool/readonly.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define PATH_MAX_HERE 4096

static bool is_forbidden(const char *path)
{
    return access(path, W_OK) != 0 && (errno == EROFS || errno == EACCES || errno == EPERM);
}

/* False: too long a name. */
static bool name_folder(const char *path, char folder[PATH_MAX_HERE])
{
    const char *slash = strrchr(path, '/');
    int n = slash == NULL   ? snprintf(folder, PATH_MAX_HERE, ".")
            : slash == path ? snprintf(folder, PATH_MAX_HERE, "/")
                            : snprintf(folder, PATH_MAX_HERE, "%.*s", (int)(slash - path), path);
    return n < PATH_MAX_HERE;
}

bool pf_spool_is_read_only(const char *path)
{
    char folder[PATH_MAX_HERE];
    return is_forbidden(path) || (name_folder(path, folder) && is_forbidden(folder));
}

bool pf_spool_look_at_disk(const char *path, struct statvfs *disk)
{
    char folder[PATH_MAX_HERE];
    return statvfs(path, disk) == 0 || (name_folder(path, folder) && statvfs(folder, disk) == 0);
}

int pf_spool_open_read_only(const char *path, sqlite3 **db)
{
    char wal[PATH_MAX_HERE], uri[3 * PATH_MAX_HERE + 64] = "file:";
    size_t n = strlen(uri);
    struct stat log;
    if (snprintf(wal, sizeof wal, "%s-wal", path) >= (int)sizeof wal)
        return SQLITE_CANTOPEN;
    for (const char *c = path; *c != '\0'; c++)
        n += (size_t)sprintf(uri + n, strchr("%?#", *c) != NULL ? "%%%02X" : "%c", (unsigned)(unsigned char)*c);
    /* With a log: SQLite reads it only under a lock, which a file that is open for reading cannot have; the VFS without
     * locks grants it. Without one: an immutable file is the only one whose missing log SQLite does not try to make. */
    bool has_log = stat(wal, &log) == 0 && log.st_size > 0;
    (void)strcpy(uri + n, has_log ? "?mode=ro&vfs=unix-none" : "?mode=ro&immutable=1");
    return sqlite3_open_v2(uri, db, SQLITE_OPEN_READONLY | SQLITE_OPEN_URI | SQLITE_OPEN_NOMUTEX, NULL);
}
