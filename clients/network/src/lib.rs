//! Transfer of topics between machines over UDP: the verbs `gateway`, `listen` and `key`, and those of their parts that
//! the bridge uses, too.
#![forbid(unsafe_code)]

use scanhub_client::clock;

mod forward;
mod gateway;
mod gateway_identity;
mod interface;
mod key_file;
pub mod lan;
mod listen;
mod remote_receiver;

pub use forward::{Forwarder, SampleSink, Selection, report_notice, write_counters};
pub use gateway::GatewayArgs;
pub use gateway_identity::{GatewayIdentity, begin_run};
pub use key_file::KeyArgs;
pub use listen::ListenArgs;
pub use remote_receiver::{ClassNames, Origin, ReceiverConfig, RemoteReceiver, received_topics};

/// Returns the current time of both clocks.
pub fn now() -> lan::WallTimestamp {
    lan::WallTimestamp { monotonic_ns: clock::now_ns(), wall_ns: clock::wall_ns() }
}
