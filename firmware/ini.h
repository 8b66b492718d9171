/* INI files: [section], key = value, comments after # or ; at the start of a line or after white space. A value may
 * stand in double quotes to keep spaces, # and ; in it. Lines may end as Windows ends them, behind a byte order mark.
 */
#ifndef PIPEFISHD_INI_H
#define PIPEFISHD_INI_H

#include <stdbool.h>
#include <stddef.h>

#define PF_INI_LINE_MAX 1024u /* most bytes of one line */

typedef struct pf_ini_item {
    const char *section, *key, *value; /* value: trimmed, without its quotes; "" if there is nothing after the = */
    unsigned line;                     /* from 1 */
} pf_ini_item;

/* Takes one item; false with a text in error[n] (without file and line) stops the parsing. */
typedef bool (*pf_ini_handler)(void *user, const pf_ini_item *item, char *error, size_t n);

/* Parses text[n], any bytes at all. False: error[error_n] holds "file:line: what". */
bool pf_ini_parse(const char *text, size_t n, const char *file, pf_ini_handler handler, void *user, char *error,
                  size_t error_n);

#endif
