//! What the two ends of a bridge accounted, compared row by row.

use std::collections::BTreeMap;

use serde_json::Value;

use crate::{Row, row};

/// The sums over all sensors and topics, announcements aside.
#[derive(Default)]
pub(crate) struct Account {
    pub(crate) sent: u64,
    pub(crate) bytes: u64,
    pub(crate) missed: u64,
    pub(crate) replaced: u64,
    pub(crate) received: u64,
    pub(crate) lost: u64,
    /// Rows in which the two ends differ.
    pub(crate) wrong: Vec<String>,
}

impl Account {
    /// Whether both ends say the same.
    pub(crate) fn agreement(&self) -> Row {
        let first = self.wrong.first().map_or(String::new(), |first| format!(", the first {first}"));
        let value = format!("{}{first}", self.wrong.len());
        row("rows of the account in which the two ends differ", value, Some(("0", self.wrong.is_empty())))
    }
}

/// Compares what the sender and the receiver told last.
pub(crate) fn compare(sender: &[Value], receiver: &[Value]) -> Account {
    let (there, here) = (last(sender, "sent"), last(receiver, "received"));
    let mut account = Account::default();
    for (name, row) in &there {
        let number = |row: &Value, key: &str| row[key].as_u64().unwrap_or_default();
        let other = here.get(name).cloned().unwrap_or_default();
        let [sent, replaced, missed, bytes] =
            ["sent", "replaced", "missed", "bytes"].map(|key| number(row, key));
        let [received, lost, told] = ["received", "lost", "replaced"].map(|key| number(&other, key));
        // Announcements do not tell of themselves, and the last one is not announced.
        let is_announce = name.ends_with("/announce");
        if sent != received + lost || !is_announce && replaced != told {
            account.wrong.push(format!("{name}: {row} and {other}"));
        }
        if !is_announce {
            account.sent += sent;
            account.bytes += bytes;
            account.missed += missed;
            account.replaced += replaced;
            account.received += received;
            account.lost += lost;
        }
    }
    account
}

/// By sensor and topic the last line of the account that has this key.
fn last(lines: &[Value], key: &str) -> BTreeMap<String, Value> {
    let mut rows = BTreeMap::new();
    for line in lines.iter().filter(|line| line["class"] == "bridge" && line[key].is_u64()) {
        let word = |key: &str| line[key].as_str().unwrap_or_default().to_owned();
        rows.insert(format!("{}/{}", word("sensor"), word("topic")), line.clone());
    }
    rows
}
