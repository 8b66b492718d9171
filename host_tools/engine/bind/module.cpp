// The Python module pipefish._engine: each room of the engine binds itself, here they meet.
#include <nanobind/nanobind.h>

namespace nb = nanobind;

void bind_calib(nb::module_ &m);
void bind_camera(nb::module_ &m);
void bind_conics(nb::module_ &m);
void bind_detect(nb::module_ &m);
void bind_group(nb::module_ &m);
void bind_link(nb::module_ &m);
void bind_match(nb::module_ &m);
void bind_segment(nb::module_ &m);
void bind_selfcal(nb::module_ &m);
void bind_sfm(nb::module_ &m);
void bind_sim(nb::module_ &m);
void bind_sim_studio(nb::module_ &m);
void bind_tube(nb::module_ &m);
void bind_unroll(nb::module_ &m);

NB_MODULE(_engine, m)
{
    m.doc() = "Compiled part of pipefish: one door for each room of the engine.";
    bind_calib(m);
    bind_camera(m);
    bind_conics(m);
    bind_detect(m);
    bind_group(m);
    bind_link(m);
    bind_match(m);
    bind_segment(m);
    bind_selfcal(m);
    bind_sfm(m);
    bind_sim(m);
    bind_sim_studio(m);
    bind_tube(m);
    bind_unroll(m);
}
