//! Results computed from a scan. Each processor is a small struct that reads a scan and fills a payload, with arrays
//! of fixed size: no heap, no clock, no telegrams. The result of a processor does not depend on which others run.

#![forbid(unsafe_code)]

pub mod background;
mod directions;
pub mod lines;
pub mod marks;
pub mod motion;
mod search;
pub mod segments;
pub mod velocity;
pub mod zones;
