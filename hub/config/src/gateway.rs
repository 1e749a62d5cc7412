//! Sections that do not belong to a link. Section `limits` applies to the topics of all links. Section `gateway` is for
//! `scanhub gateway`, which can read the hub's configuration. The topics, addresses and durations of section `gateway`
//! are text here, and the gateway parses them.

use std::path::PathBuf;

use scanhub_schema::datagram::{MIN_MTU, MTU_ETHERNET, MTU_SAFE};
use scanhub_schema::limits::TopicLimits;
use serde_json::{Value as Json, json};

use crate::section::{Section, optional, section, whole_or};

section! {
    /// Keys of section `limits`.
    pub(crate) struct LimitsKeys: "keys of limits, as { subscribers = 32 }" {
        /// subscribers of each topic, 1 to 250
        subscribers: i64 = TopicLimits::default().subscribers as i64, check whole_or(
            *TopicLimits::SUBSCRIBERS.start() as i64..=*TopicLimits::SUBSCRIBERS.end() as i64,
            format!("{} to {}", TopicLimits::SUBSCRIBERS.start(), TopicLimits::SUBSCRIBERS.end()),
        );
    }
}

section! {
    /// Section `gateway`. A key is `None` if it is not set.
    pub struct Gateway: "keys of gateway, as { interface = \"eth0\" }" {
        /// for the multicast groups; no default
        ///
        /// Network interface for the multicast groups. Without it, nothing is sent to groups.
        interface: Option<String> = None, example "\"eth0\"";
        /// default: all but telegram, lines, motion, early and cloud
        ///
        /// Topics to send: `SENSOR/TOPIC`, `SENSOR/*` or `*/TOPIC`, optionally with `:every=N`. The most specific entry
        /// wins.
        topics: Option<Vec<String>> = None, example "[\"*/zones\", \"*/scan:every=4\"]";
        /// receivers of copies; default: none
        ///
        /// Hosts that receive copies: `HOST:PORT`, `[IPV6]:PORT` or `[fe80::7%eth0]:PORT`. Names are resolved again
        /// while the gateway runs.
        to: Option<Vec<String>> = None, example "[\"10.0.0.7:22200\"]";
        /// whether to send only telegrams, without a header
        bare: Option<bool> = None;
        /// authenticates datagrams; no default
        ///
        /// File with the [key](datagram.md#keys) of the MAC of all datagrams, from `scanhub key new`.
        key_file: Option<PathBuf> = None, example "\"/etc/scanhub/lan.key\"";
        /// networks that a datagram to a group may cross
        ///
        /// Networks that a datagram to a group may cross, including the first one.
        ttl: Option<i64> = None, check optional(whole_or(0..=255, "0 to 255".into()));
        /// interval at which a background is sent again; default: only new ones are sent
        ///
        /// Interval at which a background is sent again, such as `10s`, at least 1 s. Default: never.
        background_every: Option<String> = None, example "\"10s\"";
        /// longest datagram in bytes, 576 to 1472
        ///
        /// Longest datagram in bytes, 576 to 1472, or less if the interface carries less.
        mtu: Option<i64> = None, check optional(whole_or(
            MIN_MTU as i64..=MTU_ETHERNET as i64,
            format!("{MIN_MTU} to {MTU_ETHERNET} bytes, which an Ethernet carries"),
        ));
    }
}

impl Gateway {
    /// Default of [`ttl`](Self::ttl).
    pub const TTL: i64 = 1;
    /// Default of [`mtu`](Self::mtu).
    pub const MTU: i64 = MTU_SAFE as i64;

    /// Returns all keys with the values in effect.
    pub(crate) fn effective_values(&self) -> Vec<(&'static str, Json)> {
        let mut values = self.values();
        for (key, value) in values.iter_mut().filter(|(_, value)| value.is_null()) {
            *value = match *key {
                "to" => json!([]),
                "bare" => json!(false),
                "ttl" => json!(Gateway::TTL),
                "mtu" => json!(Gateway::MTU),
                _ => Json::Null,
            };
        }
        values
    }
}
