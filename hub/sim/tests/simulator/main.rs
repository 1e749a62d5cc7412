//! Tests of the simulated scanners in virtual time. All these tests are one binary, with a module for each subject, so
//! that the dependencies are linked only once. The tests on ptys are in `tests/port`, because they run in real time and
//! must not compete with the tests of this binary for processors.

mod faults;
mod head;
mod identity_probe;
mod machine;
mod recognize;
mod search;
mod session;
mod stream_files;
mod unit;
mod worlds;
