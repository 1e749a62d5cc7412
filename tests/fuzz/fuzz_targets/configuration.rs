//! Fuzz target for flags and configuration files: `cargo fuzz run configuration`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::configuration(data));
