//! Results computed from a scan. Each processor is a small struct that reads a scan and fills a payload, with arrays
//! of fixed size: no heap, no clock, no telegrams. No processor uses another.

#![forbid(unsafe_code)]

pub mod background;
pub mod lines;
pub mod marks;
pub mod motion;
#[cfg(test)]
mod reading;
pub mod segments;
pub mod zones;
