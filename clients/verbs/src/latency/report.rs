//! The ages of a topic, as lines: objects for programs, a table for people. The keys are a contract: add, never change.

use std::io::{self, Write};

use scanhub_client::Wait;
use scanhub_schema::Flags;
use serde::Serialize;

use super::ages::Quantiles;
use super::grain::Grain;
use super::realtime::Realtime;
use super::spans::{Span, Spans};
use crate::names::TopicName;
use crate::output::{End, Output, table};

/// Class `conditions`: how it is measured.
#[derive(Serialize)]
pub(super) struct Conditions<'a> {
    class: &'static str,
    wait: &'static str,
    realtime: bool,
    memory_locked: bool,
    clock_read_ns: f64,
    clock_resolution_ns: u64,
    refused: &'a [String],
}

impl<'a> Conditions<'a> {
    pub(super) fn new(wait: Wait, realtime: &'a Realtime, grain: Grain) -> Conditions<'a> {
        Conditions {
            class: "conditions",
            wait: match wait {
                Wait::Doorbell => "doorbell",
                Wait::Event => "event",
                Wait::Spin => "spin",
            },
            realtime: realtime.priority,
            memory_locked: realtime.memory_locked,
            clock_read_ns: (grain.read_ns * 10.0).round() / 10.0,
            clock_resolution_ns: grain.resolution_ns,
            refused: &realtime.refused,
        }
    }

    /// The same for people.
    pub(super) fn text(&self, notes: &mut Output<'_>) -> Result<(), End> {
        notes.line(|line| {
            let priority = if self.realtime { "real-time priority" } else { "normal priority" };
            let locked = if self.memory_locked { "locked" } else { "not locked" };
            write!(line, "wait by {}, {priority}, memory {locked}; ", self.wait)?;
            write!(line, "the clock takes {} ns to read, ", self.clock_read_ns)?;
            write!(line, "its resolution is {} ns", self.clock_resolution_ns)
        })?;
        self.refused.iter().try_for_each(|refused| notes.line(|line| write!(line, "{refused}")))
    }
}

/// Class `latency`; a stretch of which nothing is known is null.
pub(super) fn json<'a>(name: &'a TopicName, spans: &Spans) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        topic: &'static str,
        received: u64,
        before: u64,
        ahead: u64,
        flags: Vec<&'static str>,
        age: Option<Quantiles>,
        line: Option<Quantiles>,
        hub: Option<Quantiles>,
        wake: Option<Quantiles>,
        total: Option<Quantiles>,
        network: Option<Quantiles>,
    }
    let of = |span| spans.ages(span).quantiles();
    Line {
        class: "latency",
        sensor: &name.sensor,
        topic: name.topic.name(),
        received: spans.received,
        before: spans.before,
        ahead: spans.ahead,
        flags: Flags::names(spans.flags).collect(),
        age: of(Span::Age),
        line: of(Span::Line),
        hub: of(Span::Hub),
        wake: of(Span::Wake),
        total: of(Span::Total),
        network: of(Span::Network),
    }
}

/// The state of things within a run, in a line.
pub(super) fn brief(line: &mut Vec<u8>, name: &TopicName, spans: &Spans) -> io::Result<()> {
    let topic = name.to_string();
    match spans.ages(Span::Age).quantiles() {
        Some(age) => write!(
            line,
            "{topic:<16} {:>7} age p50 {:>9} p99 {:>9} max {:>9} us",
            age.count,
            us(age.p50_ns),
            us(age.p99_ns),
            us(age.max_ns)
        ),
        None if spans.received == 0 => {
            write!(line, "{topic:<16}       - age, {NOTHING_CAME}; {}", why_nothing(name))
        }
        None => write!(line, "{topic:<16}       - age, {} received", spans.received),
    }
}

/// The end of a run: a row for each stretch that is known, and the ages as `bars` if wanted.
pub(super) fn full(out: &mut Output<'_>, name: &TopicName, spans: &Spans, bars: bool) -> Result<(), End> {
    let heads = ["us", "count", "min", "p50", "p90", "p99", "p99.9", "max"].map(str::to_owned).to_vec();
    let row = |span: Span| {
        let Quantiles { count, min_ns, p50_ns, p90_ns, p99_ns, p999_ns, max_ns } =
            spans.ages(span).quantiles()?;
        let times = [min_ns, p50_ns, p90_ns, p99_ns, p999_ns, max_ns].map(us);
        Some([vec![span.name().to_owned(), count.to_string()], times.to_vec()].concat())
    };
    let rows: Vec<_> = Span::ALL.into_iter().filter_map(row).collect();
    if !rows.is_empty() {
        table(out, &[vec![heads], rows].concat())?;
    }
    if bars {
        draw(out, spans)?;
    }
    remarks(name, spans).iter().try_for_each(|remark| out.line(|line| write!(line, "{remark}")))
}

/// What the numbers do not say.
fn remarks(name: &TopicName, spans: &Spans) -> Vec<String> {
    let mut remarks = Vec::new();
    if spans.received == 0 {
        remarks.push(format!("{name}: {NOTHING_CAME}; {}", why_nothing(name)));
    }
    if spans.before > 0 {
        let word = if spans.before == 1 { "was" } else { "were" };
        remarks.push(format!("{name}: {} {word} sent before this listened, and left out", spans.before));
    }
    if spans.flags & Flags::REMOTE != 0 {
        remarks.push(format!(
            "{name}: the network's time is measured with the wall clocks of two machines, and contains their difference"
        ));
    }
    if spans.ahead > 0 {
        remarks
            .push(format!("{name}: {} have stamps ahead of the clock here: the clocks differ", spans.ahead));
    }
    let kinds: Vec<_> = Flags::names(spans.flags).filter(|flag| *flag != "remote").collect();
    if !kinds.is_empty() {
        remarks.push(format!("{name}: {}", kinds.join(", ")));
    }
    remarks
}

pub(super) const NOTHING_CAME: &str = "no sample arrived";

/// Where it stands why nothing comes.
pub(super) fn why_nothing(name: &TopicName) -> String {
    if name.is_robot() {
        "`scanhub info` shows why".into()
    } else {
        format!("`scanhub info {}` shows why", name.sensor)
    }
}

fn draw(out: &mut Output<'_>, spans: &Spans) -> Result<(), End> {
    let bars = spans.ages(Span::Age).bars();
    let most = bars.iter().map(|bar| bar.count).max().unwrap_or_default().max(1);
    for bar in bars {
        // What is there at all is to be seen.
        let length = (bar.count * LONGEST_BAR).div_ceil(most) as usize;
        out.line(|line| {
            let (from, to) = (time(bar.from_ns), time(bar.to_ns));
            write!(line, "{from:>7} .. {to:<7} {:>7}", bar.count)?;
            if length > 0 { write!(line, " {}", "#".repeat(length)) } else { Ok(()) }
        })?;
    }
    Ok(())
}

const LONGEST_BAR: u64 = 40;

fn us(ns: u64) -> String {
    format!("{:.1}", ns as f64 / 1e3)
}

/// An edge between bars: whole numbers of a unit.
fn time(ns: u64) -> String {
    match ns {
        0..1_000_000 => format!("{} us", ns / 1_000),
        1_000_000..1_000_000_000 => format!("{} ms", ns / 1_000_000),
        _ => format!("{} s", ns / 1_000_000_000),
    }
}

#[cfg(test)]
mod tests {
    use scanhub_schema::Header;

    use super::*;
    use crate::follow::Arrival;

    fn measured() -> (TopicName, Spans) {
        let mut spans = Spans::new();
        spans.begin(1_000_000);
        for (last_ns, age_ns) in
            [(500_000, 700_000), (1_000_000, 1_500), (2_000_000, 1_600), (3_000_000, 15_000)]
        {
            let mut header =
                Header { stamp_first_ns: 400_000, stamp_last_ns: last_ns, flags: 2, ..Header::default() };
            header.set_sent_at(last_ns + 512);
            spans.take(&header, Arrival { monotonic_ns: last_ns + age_ns, wall_ns: 0 });
        }
        (TopicName::parse("front/scan").expect("a topic"), spans)
    }

    #[test]
    fn as_an_object() {
        let (name, spans) = measured();
        let line = serde_json::to_string(&json(&name, &spans)).expect("an object");
        let begin = r#"{"class":"latency","sensor":"front","topic":"scan","received":4,"before":1,"ahead":0,"flags":["simulated"],"age":{"count":3,"min_ns":1500,"p50_ns":1600,"p90_ns":15000,"p99_ns":15000,"p999_ns":15000,"max_ns":15000},"line":{"count":3,"#;
        assert!(line.starts_with(begin), "{line}");
        assert!(line.contains(r#""hub":{"count":3,"min_ns":512,"p50_ns":512,"#), "{line}");
        assert!(line.ends_with(r#","network":null}"#), "{line}");
    }

    #[test]
    fn of_a_silence_it_is_said_where_the_reason_stands() {
        for (topic, verb) in [("front/scan", "info front"), ("robot/zones", "info")] {
            let (name, spans) = (TopicName::parse(topic).expect("a topic"), Spans::new());
            let (mut line, mut text) = (Vec::new(), Vec::new());
            brief(&mut line, &name, &spans).expect("written");
            full(&mut Output::new(&mut text), &name, &spans, false).expect("written");
            let why = format!("no sample arrived; `scanhub {verb}` shows why");
            assert_eq!(String::from_utf8_lossy(&line), format!("{topic:<16}       - age, {why}"));
            assert_eq!(String::from_utf8_lossy(&text), format!("{topic}: {why}\n"));
        }
    }

    #[test]
    fn as_a_table() {
        let (name, spans) = measured();
        let mut text = Vec::new();
        full(&mut Output::new(&mut text), &name, &spans, true).expect("written");
        let text = String::from_utf8(text).expect("text");
        let expected = "\
us     count  min    p50     p90     p99     p99.9   max
line       3  600.0  1600.5  2600.0  2600.0  2600.0  2600.0
hub        3    0.5     0.5     0.5     0.5     0.5     0.5
wake       3    1.0     1.1    14.5    14.5    14.5    14.5
age        3    1.5     1.6    15.0    15.0    15.0    15.0
total      3  601.5  1602.6  2615.0  2615.0  2615.0  2615.0
   1 us .. 2 us          2 ########################################
   2 us .. 3 us          0
   3 us .. 4 us          0
   4 us .. 5 us          0
   5 us .. 6 us          0
   6 us .. 8 us          0
   8 us .. 10 us         0
  10 us .. 20 us         1 ####################
front/scan: 1 was sent before this listened, and left out
front/scan: simulated
";
        assert_eq!(text, expected);
        let mut line = Vec::new();
        brief(&mut line, &name, &spans).expect("written");
        let line = String::from_utf8(line).expect("text");
        assert_eq!(line, "front/scan             3 age p50       1.6 p99      15.0 max      15.0 us");
    }
}
