//! hub/sim
