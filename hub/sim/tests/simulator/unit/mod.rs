//! Scanners of Slamtec in simulated rooms: what they answer byte for byte, what their packets say beside what they
//! measured, what is odd about them, and how they fail.

mod answers;
mod bench;
mod decode;
mod faults;
mod points;
mod session;
