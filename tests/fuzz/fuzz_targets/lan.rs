//! Fuzz target for datagrams: `cargo fuzz run lan`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| scanhub_fuzz::lan(data));
