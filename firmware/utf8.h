/* Texts that go into messages: Protocol Buffers strings must be UTF-8, or the host cannot read the message at all. */
#ifndef PIPEFISHD_UTF8_H
#define PIPEFISHD_UTF8_H

#include <stdbool.h>

/* Whether a text is UTF-8 without control characters. */
bool pf_utf8_check(const char *text);

/* Puts a ? for each byte that is not. */
void pf_utf8_clean(char *text);

#endif
