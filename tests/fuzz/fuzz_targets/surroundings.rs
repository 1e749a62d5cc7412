//! Fuzz target for the processors that track the robot's motion: `cargo fuzz run surroundings`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::surroundings(data));
