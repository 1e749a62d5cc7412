//! What was found out of a scanner whose head turns, for people and for programs: class `probe`. Text and keys; refuses to
//! listen.

use std::fmt;

use scanhub_drivers::line::family::Model;
use scanhub_drivers::scanner;
use schema::Family;
use serde::Serialize;

use crate::listen::Overheard;

/// A scanner that was heard; what is not known is null.
#[derive(Clone, Debug, Serialize)]
pub struct Turning {
    class: &'static str,
    port: String,
    family: &'static str,
    model: Option<&'static str>,
    baud: u32,
    /// Firmware and numbers, in words.
    identity: Option<String>,
    /// How it says that it is, in words.
    health: Option<String>,
    /// Packets of measured data, within about a second.
    packets: Option<u64>,
    /// Share of the bytes that were in no packet.
    damaged: Option<f64>,
    points_per_second: Option<f64>,
    turns_per_second: Option<f64>,
    trouble: Option<String>,
}

impl Turning {
    /// What was `heard` at `port`.
    pub(crate) fn new(port: String, heard: &Overheard) -> Turning {
        let known = |value: f64| (value > 0.0).then(|| (value * 100.0).round() / 100.0);
        let is_heard = heard.packets > 0 || heard.said.is_none();
        Turning {
            class: "probe",
            port,
            family: heard.family.name(),
            model: heard.model.map(|model| model.name),
            baud: heard.rate,
            identity: heard.said.as_ref().map(|said| said.identity.clone()),
            health: heard.said.as_ref().map(|said| said.health.clone()).filter(|words| !words.is_empty()),
            packets: is_heard.then_some(heard.packets),
            damaged: is_heard.then(|| heard.damaged()),
            points_per_second: known(heard.points_per_second),
            turns_per_second: known(heard.turns_per_second),
            // Where the line damages bytes, what else is wrong may follow from it.
            trouble: heard.line_trouble().or_else(|| heard.trouble.clone()),
        }
    }
}

impl Turning {
    /// Returns the models that a scanner cannot be distinguished from, unless it has identified itself.
    fn alike(&self) -> String {
        let features = Family::parse(self.family).and_then(scanner::features);
        let models = features.map_or(&[][..], |features| features.models);
        let found = models.iter().find(|model| Some(model.name) == self.model);
        let Some(found) = found.filter(|_| self.identity.is_none()) else { return String::new() };
        let is_alike = |model: &&Model| {
            model.name != found.name && (model.baud, model.beams) == (found.baud, found.beams)
        };
        let names: Vec<_> = models.iter().filter(is_alike).map(|model| model.name).collect();
        if names.is_empty() { String::new() } else { format!(" (or {}: same protocol)", names.join(", ")) }
    }
}

impl fmt::Display for Turning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut row = |label: &str, value: Option<String>| match value {
            Some(value) => writeln!(f, "  {label:<16}{value}"),
            None => Ok(()),
        };
        row("family", Some(self.family.to_owned()))?;
        row("model", self.model.map(|model| format!("{model}{}", self.alike())))?;
        row("rate", Some(format!("{} Bd", self.baud)))?;
        row("identity", self.identity.clone())?;
        row("health", self.health.clone())?;
        let heard = self.packets.zip(self.damaged);
        row(
            "packets",
            heard.map(|(packets, damaged)| {
                format!("{packets}, {:.1} % of the bytes damaged", 100.0 * damaged)
            }),
        )?;
        row("points", self.points_per_second.map(|points| format!("{points:.0} a second")))?;
        row("turns", self.turns_per_second.map(|turns| format!("{turns:.2} a second")))?;
        row("trouble", self.trouble.clone())
    }
}
