/* Invariants: any bytes decode to a known request, with texts that end, or PF_ERR_FORMAT; any bytes that are looked
 * into for the survey and the number of a keyframe have them or are refused; a keyframe of any contents encodes within
 * PF_MSG_KEYFRAME_MAX, and with PF_ERR_SPACE into every smaller buffer, and shows the survey and the number it was
 * given.
 */
#include "pipefish/messages.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n);

static void encode(const uint8_t *data, size_t n)
{
    enum { MOST = 64 };
    static uint8_t out[PF_MSG_KEYFRAME_MAX(MOST, 256)];
    pf_track tracks[MOST];
    pf_msg_keyframe k;
    size_t size = 0, jpeg_size, small, unused;
    uint64_t id = 0;
    bool has_break;
    if (n < sizeof k)
        return;
    memset(&k, 0, sizeof k);
    memcpy(k.survey_id, data, 16);
    memcpy(&k.index, data + 16, 4);
    memcpy(&k.time, data + 20, sizeof k.time);
    memcpy(&k.frame_sequence, data + 36, 8);
    memcpy(&k.telemetry.encoder_count, data + 44, 8);
    k.telemetry.has_encoder = data[52] & 1;
    k.telemetry.has_attitude = data[52] & 2;
    has_break = data[52] & 4;
    small = data[53];
    data += sizeof k;
    n -= sizeof k;
    k.tracks = tracks;
    while (k.n_tracks < MOST && n >= sizeof(pf_track)) {
        pf_track *t = &tracks[k.n_tracks++];
        memcpy(t, data, sizeof *t);
        id += 1 + (t->id & 0xFFFFFFFFFFFFFFu);
        t->id = id;
        t->status = (uint8_t)(1 + t->status % 3);
        data += sizeof *t;
        n -= sizeof *t;
    }
    jpeg_size = n < 256 ? n : 256;
    k.jpeg = data;
    k.jpeg_size = jpeg_size;
    if (pf_msg_encode_keyframe(&k, out, PF_MSG_KEYFRAME_MAX(k.n_tracks, jpeg_size), &size) != PF_OK)
        abort();
    uint8_t survey_id[16];
    uint32_t index;
    static const uint8_t none[16];
    if (memcmp(k.survey_id, none, 16) != 0 && (pf_msg_peek_keyframe(out, size, survey_id, &index) != PF_OK ||
                                               memcmp(survey_id, k.survey_id, 16) != 0 || index != k.index))
        abort();
    if (has_break && pf_msg_append_break("gap", out, PF_MSG_KEYFRAME_MAX(k.n_tracks, jpeg_size), &size) != PF_OK)
        abort();
    if (small < size && !has_break && pf_msg_encode_keyframe(&k, out, small, &unused) != PF_ERR_SPACE)
        abort();
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    pf_msg_request request;
    pf_status status = pf_msg_decode_request(data, n, &request);
    if (status == PF_OK) {
        if (request.what != PF_REQUEST_UNKNOWN && request.what != PF_REQUEST_PAIR &&
            (request.what < PF_REQUEST_GET_STATUS || request.what > PF_REQUEST_GET_STILL))
            abort();
        if (request.what == PF_REQUEST_PAIR && (memchr(request.pair.role, 0, sizeof request.pair.role) == NULL ||
                                                memchr(request.pair.name, 0, sizeof request.pair.name) == NULL))
            abort();
    } else if (status != PF_ERR_FORMAT) {
        abort();
    }
    uint8_t survey_id[16];
    uint32_t index;
    status = pf_msg_peek_keyframe(data, n, survey_id, &index);
    if (status != PF_OK && status != PF_ERR_FORMAT)
        abort();
    if (status == PF_OK && pf_msg_peek_survey_end(data, n, survey_id) != PF_OK)
        abort();
    encode(data, n);
    return 0;
}
