/* Telemetry CSV. Invariants: a refused file says where and leaves nothing to free; in an accepted one sequence and time
 * rise, and every reading is in its range. */
#include "replay.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void require(bool holds)
{
    if (!holds)
        abort();
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    pf_csv csv;
    pf_failure failure = {""};
    if (pf_csv_parse(&csv, (const char *)data, size, "some.csv", &failure) != PF_OK) {
        require(strncmp(failure.text, "some.csv:", 9) == 0 && csv.rows == NULL);
        return 0;
    }
    for (uint64_t i = 0; i < csv.n; i++) {
        const pf_csv_row *row = &csv.rows[i];
        const pf_telemetry *t = &row->telemetry;
        require(i == 0 || (row->sequence > row[-1].sequence && row->time_ns > row[-1].time_ns));
        require(isfinite(t->roll_rad) && isfinite(t->pitch_rad) && t->attitude_sigma_rad >= 0);
        require(t->has_attitude || t->attitude_sigma_rad == 0);
        require(t->gain >= 0 && t->lamp >= 0 && t->lamp <= 1);
    }
    pf_csv_free(&csv);
    return 0;
}
