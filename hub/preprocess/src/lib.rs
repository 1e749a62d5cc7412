//! From a scan to something shorter. Each processor is a small struct that reads a scan and fills a payload, with
//! arrays of fixed size and nothing else: no heap, no clock, no telegram. No processor uses another.

#![forbid(unsafe_code)]

pub mod background;
pub mod marks;
#[cfg(test)]
mod reading;
pub mod segments;
pub mod zones;
