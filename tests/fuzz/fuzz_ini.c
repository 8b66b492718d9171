/* Invariants: any bytes are parsed or refused with "f:line: what"; a parsed configuration has every number in its range
 * and every text UTF-8, so that printing it and parsing it again changes nothing; what does not go together in it is
 * named. */
#include "config.h"
#include "utf8.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    static pf_config defaults, first, second;
    static bool has_defaults; /* they are a quarter of the work */
    char error[1024] = "", line[PF_CONFIG_LINE_MAX], again[PF_CONFIG_LINE_MAX], assignment[PF_CONFIG_LINE_MAX];
    if (!has_defaults)
        pf_config_defaults(&defaults);
    has_defaults = true;
    first = defaults;
    if (!pf_config_parse(&first, (const char *)data, n, "f", error, sizeof error)) {
        if (strncmp(error, "f:", 2) != 0)
            abort();
        return 0;
    }
    second = defaults;
    for (uint32_t i = 0; i < pf_config_keys(); i++) {
        const char *equals;
        if (pf_config_line(&first, i, line, sizeof line) >= sizeof line || !pf_utf8_check(line))
            abort();
        (void)pf_config_line(&second, i, again, sizeof again);
        if (strcmp(line, again) == 0)
            continue;
        equals = strstr(line, " = ");
        (void)snprintf(assignment, sizeof assignment, "%.*s=%s", (int)(equals - line), line, equals + 3);
        if (!pf_config_override(&second, assignment, error, sizeof error))
            abort();
        (void)pf_config_line(&second, i, again, sizeof again);
        if (strcmp(line, again) != 0)
            abort();
    }
    error[0] = '\0';
    if (pf_config_check(&first, "f", error, sizeof error) != (error[0] == '\0') ||
        (error[0] != '\0' && strncmp(error, "f: ", 3) != 0))
        abort();
    return 0;
}
