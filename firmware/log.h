/* One line an event on standard error, with the level that journald understands: "<6>pipefishd: text". */
#ifndef PIPEFISHD_LOG_H
#define PIPEFISHD_LOG_H

#include <stdint.h>

/* Lines of a level above this (pf_config's PF_LOG_...) are left out. */
void pf_log_set_level(uint32_t level);

/* `format` is a literal: of the lines of one format and level no more than 60 follow each other at once, and one a
 * second after that; the next that is told says how many were not. One line, whatever the arguments: control characters
 * become spaces. Any thread. */
__attribute__((format(printf, 2, 3))) void pf_log(uint32_t level, const char *format, ...);

#endif
