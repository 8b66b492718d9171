// The Python module pipefish._engine: each room of the engine binds itself, here they meet.
#include <nanobind/nanobind.h>

namespace nb = nanobind;

void bind_camera(nb::module_ &m);
void bind_link(nb::module_ &m);
void bind_sfm(nb::module_ &m);
void bind_sim(nb::module_ &m);
void bind_sim_studio(nb::module_ &m);
void bind_tube(nb::module_ &m);

NB_MODULE(_engine, m)
{
    m.doc() = "Compiled part of pipefish: one class or function for each door of the engine's rooms.";
    bind_camera(m);
    bind_link(m);
    bind_sfm(m);
    bind_sim(m);
    bind_sim_studio(m);
    bind_tube(m);
}
