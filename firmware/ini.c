#include "ini.h"

#include <stdio.h>
#include <string.h>

static bool is_space(char c)
{
    return c == ' ' || c == '\t' || c == '\r';
}

static char *trim(char *s)
{
    size_t n;
    while (is_space(*s))
        s++;
    n = strlen(s);
    while (n > 0 && is_space(s[n - 1]))
        n--;
    s[n] = '\0';
    return s;
}

static bool is_name(const char *s)
{
    if (*s == '\0')
        return false;
    for (; *s; s++)
        if (!((*s >= 'a' && *s <= 'z') || (*s >= 'A' && *s <= 'Z') || (*s >= '0' && *s <= '9') || *s == '_' ||
              *s == '-'))
            return false;
    return true;
}

/* Ends the text at a comment sign that begins it or follows white space. */
static void cut_comment(char *s)
{
    for (char *p = s; *p; p++) {
        if ((*p == '#' || *p == ';') && (p == s || is_space(p[-1]))) {
            *p = '\0';
            return;
        }
    }
}

/* Takes the quotes off a quoted value; *value is trimmed on the left. */
static const char *unquote(char **value)
{
    char *end, *rest;
    if ((*value)[0] != '"') {
        cut_comment(*value);
        *value = trim(*value);
        return NULL;
    }
    end = strchr(*value + 1, '"');
    if (end == NULL)
        return "no closing quote";
    rest = end + 1;
    if (*rest != '\0' && !is_space(*rest))
        return "text after the closing quote";
    cut_comment(rest);
    if (*trim(rest) != '\0')
        return "text after the closing quote";
    *end = '\0';
    (*value)++;
    return NULL;
}

typedef struct parser {
    char section[PF_INI_LINE_MAX + 1];
    char line[PF_INI_LINE_MAX + 1];
    unsigned number;
} parser;

/* One line; NULL or what is wrong with it. `detail` is room for the handler's own text. */
static const char *parse_line(parser *p, pf_ini_handler handler, void *user, char *detail, size_t detail_n)
{
    pf_ini_item item;
    const char *wrong;
    char *line = trim(p->line), *equals, *value;

    if (*line == '\0' || *line == '#' || *line == ';')
        return NULL;
    if (*line == '[') {
        char *close = strchr(line, ']');
        if (close == NULL)
            return "no ] after the section's name";
        cut_comment(close + 1);
        if (*trim(close + 1) != '\0')
            return "text after the section's ]";
        *close = '\0';
        line = trim(line + 1);
        if (!is_name(line))
            return "a section's name is made of letters, digits, _ and -";
        memcpy(p->section, line, strlen(line) + 1);
        return NULL;
    }
    equals = strchr(line, '=');
    if (equals == NULL)
        return "neither [section] nor key = value";
    *equals = '\0';
    line = trim(line);
    if (!is_name(line))
        return "a key is made of letters, digits, _ and -";
    if (p->section[0] == '\0')
        return "a key before the first [section]";
    /* A comment sign right after the = begins a comment: one space stands before the value whatever was written. */
    value = equals + 1;
    while (is_space(*value))
        value++;
    wrong = unquote(&value);
    if (wrong != NULL)
        return wrong;
    item = (pf_ini_item){p->section, line, value, p->number};
    return handler(user, &item, detail, detail_n) ? NULL : detail;
}

bool pf_ini_parse(const char *text, size_t n, const char *file, pf_ini_handler handler, void *user, char *error,
                  size_t error_n)
{
    static const char mark[] = "\xEF\xBB\xBF"; /* of UTF-8, which some editors put before the first line */
    parser p = {.number = 0};
    char detail[1024];
    size_t at = n >= 3 && memcmp(text, mark, 3) == 0 ? 3 : 0;

    while (at < n) {
        const char *end = memchr(text + at, '\n', n - at);
        size_t length = end ? (size_t)(end - (text + at)) : n - at;
        const char *wrong = NULL;
        p.number++;
        if (length > PF_INI_LINE_MAX)
            wrong = "line longer than 1024 bytes";
        else if (memchr(text + at, '\0', length) != NULL)
            wrong = "a zero byte: not a text file";
        if (wrong == NULL) {
            memcpy(p.line, text + at, length);
            p.line[length] = '\0';
            detail[0] = '\0';
            wrong = parse_line(&p, handler, user, detail, sizeof detail);
        }
        if (wrong != NULL) {
            (void)snprintf(error, error_n, "%s:%u: %s", file, p.number, wrong);
            return false;
        }
        at += length + 1;
    }
    return true;
}
