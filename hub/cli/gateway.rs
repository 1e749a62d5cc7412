//! `scanhub gateway` on the command line.

use std::collections::BTreeMap;
use std::io::{IsTerminal, stdout};
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use scanhub_config::SourceMap;
use scanhub_network::{GatewayLook, GatewayOptions};
use scanhub_schema::datagram::{Announce, GROUPS, PORT, group};
use scanhub_schema::{Failure, Kind, Topic};
use scanhub_verbs::duration;

use super::{Configured, Everywhere};

/// Each flag is also a key of section `gateway` of the configuration, and wins over it.
#[derive(Args, Debug, Default)]
pub(crate) struct Gateway {
    /// Network interface for the groups: everybody on that network can read what is sent. Without it, nothing is sent to
    /// groups, and --to must name hosts. lo: this machine only
    #[arg(long, value_name = "NAME")]
    interface: Option<String>,
    /// Topics to send: front/scan, */scan for all sensors or front/* for all topics. With :every=4, only the samples of
    /// every fourth telegram. Can be repeated [default: all topics except telegram, lines, motion, early and cloud, of
    /// all sensors]
    #[arg(long = "topic", value_name = "SENSOR/TOPIC[:every=N]")]
    topics: Vec<String>,
    // Help for people, in which brackets are no link.
    #[allow(rustdoc::broken_intra_doc_links)]
    /// Host that gets copies, HOST:PORT or [IPV6]:PORT; a name is resolved again while the gateway runs. Can be repeated
    #[arg(long, value_name = "HOST:PORT")]
    to: Vec<String>,
    /// Send only telegrams, without a header, each sensor on its own port
    #[arg(long, conflicts_with = "background_every")]
    bare: bool,
    /// Authenticate every datagram with the key in this file, for `listen --key-file`. `scanhub key new` creates one
    #[arg(long, value_name = "FILE", conflicts_with = "bare")]
    key_file: Option<PathBuf>,
    /// How many networks datagrams to the groups may cross, including the first one [default: 1]
    #[arg(long, value_name = "N")]
    ttl: Option<u8>,
    /// Send the background also at this interval, not only when it is new, for example 10s
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    background_every: Option<Duration>,
    /// Longest datagram in bytes, up to 1472 if no tunnel is on the way [default: 1372]
    #[arg(long, value_name = "BYTES")]
    mtu: Option<usize>,
    #[command(flatten)]
    configured: Configured,
}

impl Gateway {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<GatewayOptions, Failure> {
        let options = self.over(&self.configured.sources().read(), everywhere)?;
        if self.topics.is_empty() {
            // They come from the configuration.
            options.check().map_err(of_section)?;
        }
        Ok(options)
    }

    /// Checks that a gateway accepts the section in `sources`.
    pub(super) fn check(sources: &SourceMap, everywhere: &Everywhere) -> Result<(), Failure> {
        Gateway::default().over(sources, everywhere)?.check().map_err(of_section)
    }

    /// Returns these flags, and values of the section in `sources` where a flag is missing.
    fn over(&self, sources: &SourceMap, everywhere: &Everywhere) -> Result<GatewayOptions, Failure> {
        let said = scanhub_config::Gateway::of(sources)?;
        let every = said.background_every.map(|text| duration::parse(&text)).transpose().map_err(|what| {
            let place = scanhub_config::Gateway::background_every_place(sources).unwrap_or_default();
            Failure::new(Kind::Configuration, format!("{place}: {what}"), "write 10s, 250ms, 5m")
        })?;
        let or = |flags: &[String], said: Option<Vec<String>>| match flags {
            [] => said.unwrap_or_default(),
            flags => flags.to_vec(),
        };
        Ok(GatewayOptions {
            interface: self.interface.clone().or(said.interface),
            topics: or(&self.topics, said.topics),
            to: or(&self.to, said.to),
            bare: self.bare || said.bare.unwrap_or_default(),
            key_file: self.key_file.clone().or(said.key_file),
            ttl: self.ttl.unwrap_or(said.ttl.unwrap_or(scanhub_config::Gateway::TTL) as u8),
            background_every: self.background_every.or(every),
            longest: self.mtu.unwrap_or(said.mtu.unwrap_or(scanhub_config::Gateway::MTU) as usize),
            look: match (everywhere.json, stdout().is_terminal()) {
                (true, _) => GatewayLook::Json,
                (false, true) => GatewayLook::Terminal,
                (false, false) => GatewayLook::Lines,
            },
            places: everywhere.places()?,
        })
    }
}

fn of_section(failure: Failure) -> Failure {
    Failure::new(Kind::Configuration, format!("section gateway: {}", failure.message), failure.hint)
}

/// Returns the groups and their topics, for the end of the help.
pub(crate) fn groups() -> String {
    let mut text = format!("Groups, port {PORT}:\n");
    for (address, topics) in groups_and_topics() {
        text += &format!("  {address}  {topics}\n");
    }
    text + "bare: 239.255.76.83, port 22201 for the first sensor, 22202 for the second ..\nSIGUSR1: print the counts so far"
}

/// The address of each multicast group, and the names of the topics that are sent to it.
fn groups_and_topics() -> Vec<(String, String)> {
    let mut groups = BTreeMap::from([(Announce::GROUP, vec!["announce"])]);
    for topic in Topic::ALL {
        groups.entry(group(topic)).or_default().push(topic.name());
    }
    let [a, b, c] = GROUPS;
    let row = |(last, topics): (u8, Vec<&str>)| (format!("{a}.{b}.{c}.{last}"), topics.join(", "));
    groups.into_iter().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_network::Selection;

    /// Reads a file of this repository, without line breaks, backquotes and the marks of doc comments.
    fn words_of(path: &str) -> String {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
        let text = std::fs::read_to_string(path).unwrap().replace(['`'], "").replace("///", "");
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn help_and_pages_name_the_topics_that_are_not_sent_by_default() {
        let left_out: Vec<_> =
            Topic::ALL.into_iter().filter(|topic| !Selection::is_default(*topic)).collect();
        let names: Vec<_> = left_out.iter().map(|topic| topic.name()).collect();
        let (last, first) = names.split_last().unwrap();
        let sentence = format!("all topics except {} and {last}", first.join(", "));
        let pages = ["docs/configuration.md", "docs/datagram.md", "docs/bridge.md"];
        for path in pages.iter().chain(&["hub/cli/gateway.rs", "clients/bridge/src/main.rs"]) {
            assert!(words_of(path).contains(&sentence), "{path} does not say: {sentence}");
        }
    }

    #[test]
    fn help_lists_every_topic_with_its_group() {
        let help = groups();
        for (address, topics) in groups_and_topics() {
            assert!(help.contains(&format!("{address}  {topics}\n")), "{help}");
        }
        let all: usize = groups_and_topics().iter().map(|(_, topics)| topics.split(", ").count()).sum();
        assert_eq!(all, Topic::ALL.len() + 1);
    }
}
