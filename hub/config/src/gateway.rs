//! Section `gateway` over all sources. Refuses to know what a gateway is: who makes one reads what only it understands.

use schema::datagram::MTU_SAFE;

/// What is said of the gateway; what is not said is nothing.
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
    /// How many routers pass a datagram on.
    pub ttl: Option<u8>,
    /// A duration, and where it is said.
    pub background_every: Option<(String, String)>,
    /// The longest datagram in bytes.
    pub mtu: Option<usize>,
}

impl Gateway {
    /// Networks that a datagram crosses if nobody says how many.
    pub const TTL: u8 = 1;
    /// The longest datagram in bytes if nobody says it.
    pub const MTU: usize = MTU_SAFE;
}
