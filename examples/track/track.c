/* The C library alone: follows corners through PGM frames and prints each track that ends, with the bearings of its two
 * ends when a camera profile is given.
 *
 *   track [--profile camera.profile] frame000.pgm frame001.pgm ...
 */
#include <pipefish/camera.h>
#include <pipefish/profile.h>
#include <pipefish/track.h>

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TRACKS 400u

typedef struct start { /* where a track began */
    uint64_t id;
    pf_point_q16 at;
} start;

static int fail(const char *what, const char *why)
{
    (void)fprintf(stderr, "track: %s: %s\n", what, why);
    return 1;
}

/* Binary PGM of 8 bits without comments. False: not one. */
static bool load_pgm(const char *path, pf_image *image, uint8_t **pixels)
{
    unsigned width, height, most;
    errno = 0;
    FILE *in = fopen(path, "rb");
    bool ok = in != NULL && fscanf(in, "P5 %5u %5u %3u", &width, &height, &most) == 3 && fgetc(in) != EOF &&
              most == 255 && width > 0 && height > 0 && width <= PF_IMAGE_SIZE_MAX && height <= PF_IMAGE_SIZE_MAX;
    *pixels = ok ? malloc((size_t)width * height) : NULL;
    ok = *pixels != NULL && fread(*pixels, width, height, in) == height;
    if (in != NULL)
        (void)fclose(in);
    if (ok)
        *image = (pf_image){*pixels, width, height, width};
    return ok;
}

static bool load_profile(const char *path, pf_profile *profile, const char **why)
{
    static uint8_t bytes[PF_PROFILE_BINARY_MAX];
    FILE *in = fopen(path, "rb");
    size_t n = in != NULL ? fread(bytes, 1, sizeof bytes, in) : 0;
    *why = "cannot be read";
    if (in != NULL)
        (void)fclose(in);
    return n > 0 && pf_profile_decode(bytes, n, profile, why) == PF_OK;
}

static void print_point(pf_point_q16 at, const pf_camera *camera)
{
    const double uv[2] = {at.x / 65536.0, at.y / 65536.0};
    double ray[3];
    (void)printf(" %.3f %.3f", uv[0], uv[1]);
    if (camera != NULL && pf_camera_unproject(camera, uv, ray, NULL, NULL) == PF_OK)
        (void)printf(" (%.6f %.6f %.6f)", ray[0], ray[1], ray[2]);
}

int main(int argc, char **argv)
{
    static pf_profile profile;
    static start starts[2 * TRACKS];
    const pf_camera *camera = NULL;
    pf_tracker *tracker = NULL;
    void *workspace = NULL;
    uint8_t *kept = NULL; /* the last frame: the tracker looks back at it */
    uint32_t known = 0;
    const int first = argc > 1 && strcmp(argv[1], "--profile") == 0 ? 3 : 1;
    if (argc <= first) {
        (void)fail("usage", "track [--profile camera.profile] FRAME.pgm...");
        return 2;
    }
    if (first > 1) {
        const char *why;
        if (!load_profile(argv[2], &profile, &why))
            return fail(argv[2], why);
        camera = &profile.camera;
    }
    for (int i = first; i < argc; i++) {
        pf_image frame;
        uint8_t *pixels;
        uint32_t n, still = 0;
        if (!load_pgm(argv[i], &frame, &pixels))
            return fail(argv[i], errno != 0 ? strerror(errno) : "no binary PGM of 8 bits, or not whole");
        if (tracker == NULL) {
            const pf_tracker_config config = {.width = frame.width, .height = frame.height, .max_tracks = TRACKS};
            size_t size = pf_tracker_workspace_size(&config);
            workspace = malloc(size);
            if (size == 0 || workspace == NULL || pf_tracker_init(&tracker, &config, workspace, size) != PF_OK)
                return fail(argv[i], "no tracker for frames of this size");
        }
        if (pf_tracker_frame(tracker, &frame, NULL, NULL) != PF_OK)
            return fail(argv[i], "a frame of another size");
        const pf_track *tracks = pf_tracker_tracks(tracker, &n);
        for (uint32_t k = 0, s = 0; k < n; k++) { /* both tables are in the order of ids */
            while (s < known && starts[s].id < tracks[k].id)
                s++;
            start from = {tracks[k].id, tracks[k].pos};
            if (s < known && starts[s].id == tracks[k].id)
                from = starts[s];
            if (tracks[k].status != PF_TRACK_LOST && i + 1 < argc) {
                starts[still++] = from; /* never overtakes s: one entry is written for one that was read or is new */
                continue;
            }
            (void)printf("%llu %u", (unsigned long long)from.id, tracks[k].age);
            print_point(from.at, camera);
            print_point(tracks[k].pos, camera);
            (void)printf("\n");
        }
        known = still;
        free(kept);
        kept = pixels;
    }
    free(kept);
    free(workspace);
    return 0;
}
