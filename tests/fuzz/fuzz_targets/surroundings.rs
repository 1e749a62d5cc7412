//! `cargo fuzz run surroundings`: the target of that name.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::surroundings(data));
