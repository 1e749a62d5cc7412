//! The classes of `--json` that are no samples and no row of the account: notices, sums of what was given up, and what
//! becomes of samples in shared memory.

use std::io::{self, Write};
use std::path::Path;

use crate::lan::GivenUp;
use scanhub_schema::datagram::{Head, PORT};
use scanhub_shm::Domain;
use serde::{Serialize, Serializer};

use super::super::publish::Publication;
use super::id;

/// Class `notice`.
#[derive(Serialize)]
pub(super) struct Notice<'a> {
    pub(super) class: &'static str,
    pub(super) kind: &'static str,
    pub(super) sensor: Option<&'a str>,
    pub(super) topic: Option<&'static str>,
    pub(super) missed: u32,
    #[serde(serialize_with = "known_id")]
    pub(super) hub: Option<u64>,
    pub(super) epoch: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) behind_ms: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) message: Option<&'a str>,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(super) here: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) number: Option<u8>,
}

impl Notice<'_> {
    /// As long as nothing else is said.
    pub(super) fn of(kind: &'static str, head: &Head) -> Self {
        Notice {
            class: "notice",
            kind,
            sensor: None,
            topic: None,
            missed: 0,
            hub: Some(head.hub),
            epoch: Some(head.epoch),
            behind_ms: None,
            message: None,
            here: false,
            number: None,
        }
    }
}

/// Class `ready`; `domain`, `root` and `pid` only of who publishes.
#[derive(Serialize)]
pub(super) struct Ready<'a> {
    class: &'static str,
    port: u16,
    interfaces: &'a [&'a str],
    key: Option<&'a str>,
    #[serde(flatten)]
    place: Option<Place<'a>>,
}

#[derive(Serialize)]
struct Place<'a> {
    domain: &'a str,
    root: &'a Path,
    pid: u32,
}

impl<'a> Ready<'a> {
    pub(super) fn new(
        interfaces: &'a [&'a str],
        domain: Option<&'a Domain>,
        key: Option<&'a str>,
    ) -> Ready<'a> {
        let place = domain.map(|domain| Place {
            domain: domain.name(),
            root: domain.root(),
            pid: std::process::id(),
        });
        Ready { class: "ready", port: PORT, interfaces, key, place }
    }
}

/// Class `lan_published` or `bridge_published`.
#[derive(Serialize)]
pub(super) struct Published<'a> {
    class: &'static str,
    sensors: Vec<&'a str>,
    unnamed: u64,
    unannounced: u64,
    late: u64,
    capacity: u64,
    shortage: u64,
    unproven: u64,
    no_room: u64,
    loan_failed: u64,
}

/// Class `lan_no_room` or `bridge_no_room`, of a gateway.
#[derive(Serialize)]
pub(super) struct NoRoom {
    pub(super) class: &'static str,
    #[serde(serialize_with = "id")]
    pub(super) hub: u64,
    pub(super) no_room: u64,
}

impl<'a> Published<'a> {
    pub(super) fn new(publication: &'a Publication, class: &'static str) -> Published<'a> {
        let left_out = publication.left_out;
        Published {
            class,
            sensors: publication.names(),
            unnamed: left_out.unnamed,
            unannounced: left_out.unannounced,
            late: left_out.late,
            capacity: left_out.capacity,
            shortage: left_out.shortage,
            unproven: left_out.unproven,
            no_room: left_out.no_room,
            loan_failed: publication.failed(),
        }
    }

    /// The same for people.
    pub(super) fn text(&self, line: &mut Vec<u8>) -> io::Result<()> {
        let Published { unnamed, unannounced, late, capacity, shortage, .. } = self;
        let Published { unproven, no_room, loan_failed, .. } = self;
        write!(line, "published: {}; left out: {unnamed} unnamed, ", self.sensors.join(", "))?;
        write!(line, "{unproven} in a gateway's first second, ")?;
        write!(line, "{unannounced} unannounced, {late} late, {capacity} beyond capacity, ")?;
        write!(line, "{no_room} beyond --memory, {shortage} for lack of room, {loan_failed} without memory")
    }
}

/// Class `lan_given_up` or `bridge_given_up`.
#[derive(Serialize)]
pub(super) struct Sums {
    class: &'static str,
    lives: u64,
    displaced: u64,
    received: u64,
    lost: u64,
    duplicate: u64,
    reordered: u64,
}

impl Sums {
    pub(super) fn new(given_up: GivenUp, class: &'static str) -> Sums {
        let GivenUp { lives, displaced, received, lost, duplicate, reordered } = given_up;
        Sums { class, lives, displaced, received, lost, duplicate, reordered }
    }

    /// The same for people.
    pub(super) fn text(&self, line: &mut Vec<u8>) -> io::Result<()> {
        let Sums { lives, displaced, received, lost, duplicate, reordered, .. } = self;
        write!(
            line,
            "of {lives} former starts of gateways together, {displaced} of them given up for others: "
        )?;
        write!(line, "received {received}, lost {lost}, ")?;
        write!(line, "duplicate {duplicate}, reordered {reordered}")
    }
}

fn known_id<S: Serializer>(hub: &Option<u64>, serializer: S) -> Result<S::Ok, S::Error> {
    match hub {
        Some(hub) => id(hub, serializer),
        None => serializer.serialize_none(),
    }
}
