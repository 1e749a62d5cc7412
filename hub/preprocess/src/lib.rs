//! Processors of scans. Each processor is a struct that reads a scan and fills a payload, without heap allocation,
//! clock or I/O. The result of a processor does not depend on which other processors run.

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
