//! Fuzz target for the contents of LMS telegrams: `cargo fuzz run replies`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::replies(data));
