//! `scanhub gateway`, with the section `gateway` of the configuration for missing arguments.

use clap::Args;
use scanhub_config::SourceMap;
use scanhub_network::GatewayArgs;
use scanhub_schema::{Failure, Kind};
use scanhub_verbs::context::{Context, DomainOptions};
use scanhub_verbs::duration;

use super::run::ConfigOptions;

/// Send topics to other machines as UDP datagrams, to multicast groups or single hosts
#[derive(Args, Debug, Default)]
pub(crate) struct Gateway {
    #[command(flatten)]
    args: GatewayArgs,
    #[command(flatten)]
    configured: ConfigOptions,
}

impl Gateway {
    /// Runs the gateway with the values of the configuration for arguments that are missing.
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let args = merge_section(&self.args, &self.configured.sources().read())?;
        if self.args.topics.is_empty() {
            // The error comes from the configuration, so name its section.
            args.check().map_err(in_gateway_section)?;
        }
        args.run(context)
    }

    /// Checks that a gateway would accept the section in `sources`.
    pub(super) fn check(sources: &SourceMap, domain: &DomainOptions) -> Result<(), Failure> {
        let args = merge_section(&GatewayArgs::default(), sources)?;
        domain.locations()?;
        args.check().map_err(in_gateway_section)
    }
}

/// Returns `args`. Missing arguments get the values of the section in `sources`.
fn merge_section(args: &GatewayArgs, sources: &SourceMap) -> Result<GatewayArgs, Failure> {
    let section = scanhub_config::Gateway::of(sources)?;
    let every = section.background_every.map(|text| duration::parse(&text)).transpose().map_err(|what| {
        let location = scanhub_config::Gateway::background_every_location(sources).unwrap_or_default();
        Failure::new(Kind::Configuration, format!("{location}: {what}"), "write 10s, 250ms, 5m")
    })?;
    let or = |args: &[String], section: Option<Vec<String>>| match args {
        [] => section.unwrap_or_default(),
        args => args.to_vec(),
    };
    Ok(GatewayArgs {
        interface: args.interface.clone().or(section.interface),
        topics: or(&args.topics, section.topics),
        to: or(&args.to, section.to),
        bare: args.bare || section.bare.unwrap_or_default(),
        key_file: args.key_file.clone().or(section.key_file),
        ttl: args.ttl.or(section.ttl.map(|ttl| ttl as u8)),
        background_every: args.background_every.or(every),
        mtu: args.mtu.or(section.mtu.map(|mtu| mtu as usize)),
    })
}

fn in_gateway_section(failure: Failure) -> Failure {
    Failure::new(Kind::Configuration, format!("section gateway: {}", failure.message), failure.hint)
}
