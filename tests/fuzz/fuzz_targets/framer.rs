//! Fuzz target for the framer of LMS telegrams: `cargo fuzz run framer`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::framer(data));
