/* Of what is freed the sanitizer keeps 4 MB out of use, not 256: an input frees less than that, so that a use after
 * free is seen as before, and what the next input allocates is in the cache, not a page that the kernel has to clear.
 */
const char *__asan_default_options(void);

const char *__asan_default_options(void)
{
    return "quarantine_size_mb=4";
}
