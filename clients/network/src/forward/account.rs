//! The account of what goes out, by sensors and topics, in the words of a network. Refuses to know what carries it.

use std::io::Write;

use crate::lan::outgoing::{Outgoing, Row};
use scanhub_schema::Topic;
use serde::Serialize;

use super::Life;
use scanhub_verbs::output::{End, Output};

/// Tells the account of what goes `out` in this `life`: lines of JSON of this `class`, or text.
///
/// # Errors
///
/// If it cannot be written.
pub fn account(
    outgoing: &Outgoing,
    life: &Life,
    class: &'static str,
    json: bool,
    out: &mut Output<'_>,
) -> Result<(), End> {
    let hub = format!("{:016x}", life.hub);
    for sensor in outgoing.account() {
        for (topic, row) in sensor.used() {
            let topic = topic.map_or("announce", Topic::name);
            let Row { sent, failed, bytes, missed, .. } = *row;
            let replaced = outgoing.tells_replaced().then_some(row.replaced);
            if json {
                let (hub, epoch, sensor) = (&hub, life.epoch, &sensor.name);
                let send_failed = failed;
                out.json(&Line {
                    class,
                    hub,
                    epoch,
                    sensor,
                    topic,
                    sent,
                    send_failed,
                    bytes,
                    missed,
                    replaced,
                })?;
                continue;
            }
            out.line(|line| {
                write!(line, "{}/{topic}: {sent} sent, ", sensor.name)?;
                replaced.map_or(Ok(()), |replaced| write!(line, "{replaced} replaced, "))?;
                write!(line, "{failed} failed, {bytes} bytes")?;
                if missed > 0 { write!(line, ", {missed} missed") } else { Ok(()) }
            })?;
        }
    }
    Ok(())
}

/// Class `lan` or `bridge` of what goes out.
#[derive(Serialize)]
struct Line<'a> {
    class: &'static str,
    hub: &'a str,
    epoch: u32,
    sensor: &'a str,
    topic: &'static str,
    sent: u64,
    send_failed: u64,
    bytes: u64,
    missed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    replaced: Option<u64>,
}
