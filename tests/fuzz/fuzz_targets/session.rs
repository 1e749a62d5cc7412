//! Fuzz target for the LMS session: `cargo fuzz run session`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::session(data));
