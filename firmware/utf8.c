#include "utf8.h"

#include <stddef.h>

/* Bytes of the character at s, 0 if it is none (RFC 3629: no overlong forms, no surrogates, up to U+10FFFF). */
static size_t character(const unsigned char *s)
{
    size_t n;
    unsigned least = 0x80, most = 0xBF;
    if (s[0] < 0x80)
        return s[0] >= 0x20 && s[0] != 0x7F ? 1 : 0;
    if (s[0] >= 0xC2 && s[0] <= 0xDF)
        n = 2;
    else if (s[0] >= 0xE0 && s[0] <= 0xEF)
        n = 3;
    else if (s[0] >= 0xF0 && s[0] <= 0xF4)
        n = 4;
    else
        return 0;
    if (s[0] == 0xE0)
        least = 0xA0;
    else if (s[0] == 0xED)
        most = 0x9F;
    else if (s[0] == 0xF0)
        least = 0x90;
    else if (s[0] == 0xF4)
        most = 0x8F;
    if (s[1] < least || s[1] > most)
        return 0;
    for (size_t i = 2; i < n; i++)
        if (s[i] < 0x80 || s[i] > 0xBF)
            return 0;
    return n;
}

bool pf_utf8_check(const char *text)
{
    const unsigned char *s = (const unsigned char *)text;
    while (*s) {
        size_t n = character(s);
        if (n == 0)
            return false;
        s += n;
    }
    return true;
}

void pf_utf8_clean(char *text)
{
    unsigned char *s = (unsigned char *)text;
    while (*s) {
        size_t n = character(s);
        if (n == 0)
            *s = '?';
        s += n ? n : 1;
    }
}
