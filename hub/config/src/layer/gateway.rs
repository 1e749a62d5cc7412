//! The keys of section `gateway`, and their valid values. A value is checked in its own source.

use std::path::PathBuf;

use schema::Failure;
use schema::datagram::{MTU_ETHERNET, MTU_LEAST};
use serde::Deserialize;
use toml::Spanned;

use crate::gateway::Gateway;
use crate::origin::Origin;

/// Section `gateway`.
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
    /// Lays what it says over `gateway`.
    pub(crate) fn lay(self, origin: &Origin, gateway: &mut Gateway) -> Result<(), Failure> {
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
