//! Fuzz target for recordings: `cargo fuzz run recording`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::recording(data));
