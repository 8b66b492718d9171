// The optimiser's algebra, for the shapes in use.
#include "optim/least_squares.hpp"

namespace pipefish::optim
{

template class NormalMatrix<1, 1>; // no chain, nothing eliminated: a tube, a cylinder, a plane
template class ArrowFactor<1, 1>;
template class NormalMatrix<3, 6>; // points and poses
template class ArrowFactor<3, 6>;
template class NormalMatrix<5, 1>; // relative poses of pairs, without a chain
template class ArrowFactor<5, 1>;
template class NormalMatrix<6, 1>; // poses of a calibration, without a chain
template class ArrowFactor<6, 1>;

} // namespace pipefish::optim
