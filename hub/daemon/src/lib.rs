//! hub/daemon
