//! Sends the topics of a hub to other machines and publishes the topics of other machines in this one: the verbs
//! `gateway`, `listen` and `key`, and the parts of them that the bridge uses too.
#![forbid(unsafe_code)]

use std::path::Path;

use scanhub_client::clock;
use scanhub_schema::Failure;
use scanhub_shm::{Domain, Environment};

mod forward;
mod gateway;
mod gateway_identity;
mod interface;
mod key_file;
pub mod lan;
mod listen;
mod reception;

pub use forward::{Carrier, Forwarder, Selection, account, tell};
pub use gateway::{GatewayArgs, groups_help};
pub use gateway_identity::{Life, begin_life};
pub use key_file::KeyArgs;
pub use listen::{LISTEN_SIGNALS, ListenArgs};
pub use reception::{Origin, Reception, Wanted, Words, received_topics};

/// Returns this moment on both clocks.
pub fn now() -> lan::Stamp {
    lan::Stamp { monotonic_ns: clock::now_ns(), wall_ns: clock::wall_ns() }
}

/// Options of the program that all verbs have.
#[derive(Clone, Copy, Debug)]
pub struct VerbOptions<'a> {
    /// Name of the domain.
    pub domain: &'a str,
    /// Directory of the hub, if it is not at one of the usual locations.
    pub root: Option<&'a Path>,
    /// Whether to print one JSON object per line.
    pub json: bool,
}

impl VerbOptions<'_> {
    /// Returns the locations in which a client looks for the domain.
    fn places(&self) -> Result<Vec<Domain>, Failure> {
        Domain::candidates(self.domain, self.root, &Environment::of_process())
    }

    /// Returns the domain in which a program publishes: the running one, otherwise that of a hub that starts now.
    fn publisher_domain(&self) -> Result<Domain, Failure> {
        scanhub_shm::publisher_domain(self.domain, self.root, &Environment::of_process())
    }
}
