//! Sends the topics of a hub to other machines and publishes the topics of other machines in this one: the verbs
//! `gateway`, `listen` and `key`, and the parts of them that the bridge uses too.
#![forbid(unsafe_code)]

mod forward;
mod gateway;
mod interface;
mod key_file;
pub mod lan;
mod listen;
mod reception;
mod stamp;

pub use forward::{Carrier, Forwarder, Life, Selection, account, begin_life, tell};
pub use gateway::{GatewayLook, GatewayOptions, gateway};
pub use key_file::new_key;
pub use listen::{ListenOptions, listen};
pub use reception::{Origin, Reception, Wanted, Words, received_topics};
pub use stamp::now;
