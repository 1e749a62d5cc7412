//! The simulated sensor in virtual time: one binary with a module for each thing that is held, so that what they all
//! link is linked once. The tests on ptys are in `tests/port`: they must not wait for processors that these tests use.

mod faults;
mod head;
mod inquiry;
mod machine;
mod recognize;
mod search;
mod session;
mod stream_files;
mod unit;
mod worlds;
