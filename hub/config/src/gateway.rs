//! Section `gateway` from all sources. Refuses to know what a gateway is: the gateway reads what only it understands.

use std::path::PathBuf;

use schema::datagram::MTU_SAFE;

/// The settings of the gateway; `None` for what is not set.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Gateway {
    /// Name of the network interface.
    pub interface: Option<String>,
    /// `SENSOR/TOPIC` or `*/TOPIC`, possibly with `:every=N`.
    pub topics: Option<Vec<String>>,
    /// `HOST:PORT` of those that get copies.
    pub to: Option<Vec<String>>,
    /// Telegrams and nothing else, without a header.
    pub bare: Option<bool>,
    /// The file with the key of which datagrams get a MAC.
    pub key_file: Option<PathBuf>,
    /// How many routers pass a datagram on.
    pub ttl: Option<u8>,
    /// A duration, and where it is set.
    pub background_every: Option<(String, String)>,
    /// The longest datagram in bytes.
    pub mtu: Option<usize>,
}

impl Gateway {
    /// Networks that a datagram crosses by default.
    pub const TTL: u8 = 1;
    /// The longest datagram in bytes by default.
    pub const MTU: usize = MTU_SAFE;
}
