//! Section `gateway`: its values in effect, and its keys in one source. Topics, addresses and durations are text here;
//! the gateway parses them.

use std::path::PathBuf;

use schema::Failure;
use schema::datagram::{MTU_ETHERNET, MTU_LEAST, MTU_SAFE};
use serde::Deserialize;
use toml::Spanned;

use crate::sources::Origin;

/// Settings of the gateway; `None` for those that are not set.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Gateway {
    /// Name of the network interface.
    pub interface: Option<String>,
    /// `SENSOR/TOPIC` or `*/TOPIC`, possibly with `:every=N`.
    pub topics: Option<Vec<String>>,
    /// `HOST:PORT` of each receiver of a copy.
    pub to: Option<Vec<String>>,
    /// Whether datagrams are telegrams without a header.
    pub bare: Option<bool>,
    /// File with the key for the MAC of datagrams.
    pub key_file: Option<PathBuf>,
    /// Maximum number of networks that a datagram crosses.
    pub ttl: Option<u8>,
    /// A duration, and the place where it is set.
    pub background_every: Option<(String, String)>,
    /// Maximum length of a datagram in bytes.
    pub mtu: Option<usize>,
}

impl Gateway {
    /// Default of [`ttl`](Self::ttl).
    pub const TTL: u8 = 1;
    /// Default of [`mtu`](Self::mtu).
    pub const MTU: usize = MTU_SAFE;
}

/// Keys of section `gateway`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct GatewayLayer {
    interface: Option<String>,
    topics: Option<Vec<String>>,
    to: Option<Vec<String>>,
    bare: Option<bool>,
    key_file: Option<PathBuf>,
    ttl: Option<Spanned<i64>>,
    background_every: Option<Spanned<String>>,
    mtu: Option<Spanned<i64>>,
}

impl GatewayLayer {
    /// Applies the keys that are set to `gateway`.
    pub(crate) fn apply(self, origin: &Origin, gateway: &mut Gateway) -> Result<(), Failure> {
        let GatewayLayer { interface, topics, to, bare, key_file, ttl, background_every, mtu } = self;
        gateway.interface = interface.or(gateway.interface.take());
        gateway.topics = topics.or(gateway.topics.take());
        gateway.to = to.or(gateway.to.take());
        gateway.bare = bare.or(gateway.bare);
        gateway.key_file = key_file.or(gateway.key_file.take());
        if let Some(ttl) = ttl {
            let value = u8::try_from(*ttl.get_ref());
            let refuse = |_| origin.refuse(Some(ttl.span()), format!("ttl = {}", ttl.get_ref()), "0 to 255");
            gateway.ttl = Some(value.map_err(refuse)?);
        }
        if let Some(every) = background_every {
            let place = origin.place(Some(every.span()));
            gateway.background_every = Some((every.into_inner(), place));
        }
        if let Some(mtu) = mtu {
            let value = usize::try_from(*mtu.get_ref()).ok();
            let value = value.filter(|value| (MTU_LEAST..=MTU_ETHERNET).contains(value));
            gateway.mtu = Some(value.ok_or_else(|| {
                let remedy = format!("{MTU_LEAST} to {MTU_ETHERNET} bytes, which an Ethernet carries");
                origin.refuse(Some(mtu.span()), format!("mtu = {}", mtu.get_ref()), remedy)
            })?);
        }
        Ok(())
    }
}
