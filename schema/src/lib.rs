//! The words everyone speaks: what the hub publishes, and the names under which it does. Knows nobody.

mod failure;

pub use failure::{Failure, Kind};
