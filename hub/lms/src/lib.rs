//! Bytes to telegrams and back, and the conversation with a SICK LMS 2xx. No I/O, no clock, no heap.
#![no_std]
#![forbid(unsafe_code)]
