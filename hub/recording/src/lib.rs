//! hub/recording
