//! Fuzz target for the processors of single scans: `cargo fuzz run processors`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::processors(data));
