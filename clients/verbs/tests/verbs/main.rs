//! Tests of the verbs with a fake hub. The tests are modules of one binary, so that their dependencies are linked only
//! once.

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

use std::fs::File;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use scanhub_verbs::context::{Context, DomainOptions};

use fake::TestDomain;

/// Returns the options with which a user would name the domain of `test_domain`.
fn domain_options(test_domain: &TestDomain) -> DomainOptions {
    DomainOptions { name: test_domain.domain.name().to_owned(), root: Some(test_domain.base.clone()) }
}

/// Returns the context of a verb that writes to `out` and `notes` until `stop` is set.
fn context(domain: DomainOptions, json: bool, out: File, notes: File, stop: Arc<AtomicBool>) -> Context {
    Context::new(json, domain, (out, notes), Box::new(stop))
}
