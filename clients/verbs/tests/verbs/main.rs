//! The verbs against a hub that a test makes: one binary with a module for each thing that is held, so that what they all
//! link is linked once.

#[path = "../../../../tests/testkit/child.rs"]
mod child;
#[path = "../../../client/tests/fake/mod.rs"]
mod fake;

mod background;
mod echo;
mod latency;
mod restart;
mod verbs;
mod zones;
