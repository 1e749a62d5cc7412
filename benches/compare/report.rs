//! The tables, one for each length of messages, number of receivers and rate. The targets say what topics should cost
//! compared with the baselines and the cheapest socket.

use serde_json::{Value, json};

use super::message::{PHASES, SCAN, Way};
use super::run::{Case, Measured};
use super::{Cell, MEBIBYTE};
use crate::support::Options;
use crate::support::figures::{self, Spread, percentile};

/// Value of a figure.
type Of = fn(&Measured) -> Option<f64>;

/// Prints all tables, after the machine. With `--json`: a line `{class: "machine", bench, machine, processors, runs}`,
/// the digests as cells, and a line of class `compared` with all figures of a mechanism, length, number and rate.
pub(crate) fn print_tables(options: &Options, processors: usize, pairs: usize, cells: &[Cell]) {
    let digests = cells.iter().flat_map(digests).collect::<Vec<_>>();
    if options.json {
        let line = json!({
            "class": "machine", "bench": "compare", "machine": machine(), "processors": processors, "runs": pairs,
        });
        println!("{line}");
        figures::print_cells("compare", true, &in_tables(digests));
        cells.iter().for_each(|cell| println!("{}", compared(cell)));
        return;
    }
    println!("{}, {processors} processors, {pairs} runs each: median [least .. most]", machine());
    println!(
        "With more receivers than processors the last one waits for the others' CPU time, with every mechanism. \
         Datagrams of UDP hold 65507 bytes and those of Unix sockets 65536 here: longer messages are sent in parts. \
         Flat out, streams, pipes and Unix datagrams wait for their receivers, multicast and topics lose."
    );
    figures::print_cells("compare", false, &in_tables(cells.iter().flat_map(columns).collect()));
    figures::print_cells("compare", false, &in_tables(digests));
}

const LATENCY: [(&str, &str, Of); 6] = [
    ("p50", "us", |run| run.latency[0]),
    ("p99", "us", |run| run.latency[1]),
    ("p99.9", "us", |run| run.latency[2]),
    ("last, p50", "us", |run| run.last[0]),
    ("last, p99", "us", |run| run.last[1]),
    ("last, p99.9", "us", |run| run.last[2]),
];
const COST: [(&str, &str, Of); 6] = [
    ("sender, a message", "us", |run| Some(run.sender_us)),
    ("of it sending", "us", |run| run.sending_us),
    ("receiver, a message", "us", |run| run.receiver_us),
    ("received, a second", "1/s", |run| Some(run.rate_hz)),
    ("missed", "%", |run| Some(run.missed_percent)),
    ("sent, of the rate", "%", |run| run.kept_percent),
];

/// Returns all figures, for people.
fn columns(cell: &Cell) -> Vec<figures::Cell> {
    let Case { way, payload, receivers } = cell.case;
    let figure = |what: &str, (column, unit, of): (&str, &'static str, Of)| figures::Cell {
        table: format!("{payload} B to {receivers}, {}: {what}", PHASES[cell.phase].name),
        row: way.name().into(),
        column: column.into(),
        unit,
        values: values(cell, of),
    };
    let latency = LATENCY.into_iter().map(|column| figure("latency", column));
    latency.chain(COST.into_iter().map(|column| figure("cost", column))).collect()
}

/// Returns the most important figures, over the number of receivers.
fn digests(cell: &Cell) -> Vec<figures::Cell> {
    const PACED: [(&str, &str, Of); 2] = [
        ("latency of the last receiver, p50", "us", |run| run.last[0]),
        ("CPU time of the sender for a message", "us", |run| Some(run.sender_us)),
    ];
    const FLAT_OUT: [(&str, &str, Of); 1] = [("received by each, a second", "1/s", |run| Some(run.rate_hz))];
    let Case { way, payload, receivers } = cell.case;
    let figure = |(what, unit, of): &(&str, &'static str, Of)| figures::Cell {
        table: format!("{payload} B, {}: {what}", PHASES[cell.phase].name),
        row: way.name().into(),
        column: format!("to {receivers}"),
        unit,
        values: values(cell, *of),
    };
    let all: &[_] = if cell.is_paced() { &PACED } else { &FLAT_OUT };
    all.iter().map(figure).collect()
}

/// Returns the cells that could be measured.
fn in_tables(mut cells: Vec<figures::Cell>) -> Vec<figures::Cell> {
    cells.retain(|cell| !cell.values.is_empty());
    cells
}

fn compared(cell: &Cell) -> Value {
    let Case { way, payload, receivers } = cell.case;
    let mut line = json!({
        "class": "compared", "bench": "compare", "way": way.name(), "bytes": payload, "receivers": receivers,
        "rate": PHASES[cell.phase].name,
    });
    for (name, unit, of) in LATENCY.into_iter().chain(COST) {
        line[format!("{name}, {unit}")] = json!(Spread::of(&values(cell, of)).map(|spread| spread.json()));
    }
    line
}

/// Returns the value of each run that has one.
fn values(cell: &Cell, of: Of) -> Vec<f64> {
    cell.runs.iter().filter_map(of).collect()
}

/// Returns processor and kernel.
fn machine() -> String {
    let read = |path| std::fs::read_to_string(path).unwrap_or_default();
    let (processor, kernel) = (read("/proc/cpuinfo"), read("/proc/sys/kernel/osrelease"));
    let model = processor.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    format!("{}, Linux {}", model.map_or("unknown processor", |(_, model)| model), kernel.trim())
}

/// Prints what topics should cost compared with the baselines and with the cheapest socket, and whether they do. With
/// `--json` as lines of class `measurement`, whose baseline is what topics are compared with, and of class `above` for
/// each cell in which a socket is cheaper.
pub(crate) fn print_targets(options: &Options, cells: &[Cell]) {
    let mut verdicts = Vec::new();
    for cell in cells.iter().filter(|cell| cell.is_paced()) {
        verdicts.extend(of_waits(cell, cells));
        verdicts.extend(of_spinning(cell, cells));
        verdicts.extend(of_subscriptions(cell, cells));
        verdicts.extend(of_many(cell, cells));
    }
    verdicts.extend(of_sockets(cells));
    verdicts.iter().for_each(|verdict| verdict.print(options.json));
}

/// A target of a topic, and whether it was met.
struct Verdict {
    class: &'static str,
    name: String,
    unit: &'static str,
    /// One value per run.
    ours: Vec<f64>,
    /// One value per run of what it is compared with; empty if it is not compared.
    other: Vec<f64>,
    target: String,
    is_met: bool,
}

impl Verdict {
    /// Compares `cell` with `other`; it should take at most `most` times as much.
    fn beside(cell: &Cell, other: &Cell, (quantity, of): (&str, Of), most: f64) -> Option<Verdict> {
        let mut verdict = Verdict {
            class: "measurement",
            name: format!("{cell}, {quantity} beside {}", other.case.way.name()),
            unit: "us",
            ours: values(cell, of),
            other: values(other, of),
            target: format!("ratio <= {most}"),
            is_met: false,
        };
        verdict.is_met = middle(verdict.ratios())? <= most;
        Some(verdict)
    }

    /// Returns the ratios run by run, because the runs of a pair are within the same minute.
    fn ratios(&self) -> Vec<f64> {
        self.ours.iter().zip(&self.other).map(|(ours, other)| ours / other).collect()
    }

    fn print(&self, as_json: bool) {
        let Verdict { class, name, unit, ours, other, target, is_met } = self;
        let spreads = [ours, other, &self.ratios()].map(|values| Spread::of(values));
        if as_json {
            let [ours, other, ratio] = spreads.map(|spread| spread.map(|spread| spread.json()));
            let line = json!({
                "class": class, "bench": "compare", "name": name, "unit": unit, "runs": self.ours.len(),
                "hub": ours, "baseline": other, "ratio": ratio, "target": target, "met": is_met,
            });
            println!("{line}");
        } else {
            let [ours, other, ratio] =
                spreads.map(|spread| spread.map_or("-".into(), |spread| spread.text()));
            let met = if *is_met { "met" } else { "MISSED" };
            println!("{name}, {unit}: {ours}; {other}; ratio {ratio}; {target}: {met}");
        }
    }
}

/// Compares a wait of topics with the bare futex, for messages as short as the hub's.
fn of_waits(cell: &Cell, cells: &[Cell]) -> Option<Verdict> {
    let most = match cell.case.way {
        Way::Doorbell => 1.2,
        Way::Event => 1.5,
        _ => return None,
    };
    if cell.case.receivers > 1 || cell.case.payload > SHORT {
        return None;
    }
    Verdict::beside(cell, beside(cell, cells, Way::FutexBaseline)?, ("p50", |run| run.latency[0]), most)
}

/// Checks spinning, where two processors are otherwise idle.
fn of_spinning(cell: &Cell, cells: &[Cell]) -> Option<Verdict> {
    const MOST_US: f64 = 1.0;
    if cell.case.way != Way::Spin || cell.case.payload > SHORT {
        return None;
    }
    let verdict = Verdict::beside(
        cell,
        beside(cell, cells, Way::SpinBaseline)?,
        ("p50", |run| run.latency[0]),
        MOST_US,
    )?;
    let is_met = middle(verdict.ours.clone())? <= MOST_US;
    Some(Verdict { target: format!("<= {MOST_US} us where processors are free"), is_met, ..verdict })
}

/// Compares the client library with the topic that is used for all lengths here.
fn of_subscriptions(cell: &Cell, cells: &[Cell]) -> Option<Verdict> {
    const COST: (&str, Of) = ("receiver's CPU time", |run| run.receiver_us);
    if cell.case.way != Way::Subscription {
        return None;
    }
    let path = beside(cell, cells, Way::Doorbell)?;
    let is_met = !is_above(cell, path, COST.1) && !is_above(path, cell, COST.1);
    let verdict = Verdict::beside(cell, path, COST, 1.0)?;
    Some(Verdict { target: "the same within the spread".into(), is_met, ..verdict })
}

/// Checks what the hub is for: many receivers of long messages.
fn of_many(cell: &Cell, cells: &[Cell]) -> Vec<Verdict> {
    let times = match cell.case.way {
        Way::Doorbell => 50.0,
        Way::Event => 20.0,
        _ => return Vec::new(),
    };
    if cell.case.receivers != 16 || cell.case.payload != MEBIBYTE {
        return Vec::new();
    }
    let verdict = |(quantity, of): (&str, Of)| {
        let sockets = [Way::UnixDatagram, Way::UnixStream].into_iter();
        let cheapest = cheapest(sockets.filter_map(|way| beside(cell, cells, way)), of)?;
        Verdict::beside(cell, cheapest, (quantity, of), 1.0 / times)
    };
    SENDER.into_iter().filter_map(verdict).collect()
}

/// Compares sender and last receiver with the cheapest socket: a target for all cells together, then one for each cell
/// that is above it.
fn of_sockets(cells: &[Cell]) -> Vec<Verdict> {
    const LAST: (&str, Of) = ("last receiver's p50", |run| run.last[0]);
    let mut verdicts = Vec::new();
    for way in [Way::Doorbell, Way::Event] {
        for (quantity, of) in SENDER.into_iter().chain([LAST]) {
            let ours = cells.iter().filter(|cell| cell.case.way == way && cell.is_paced());
            let compared: Vec<_> = ours
                .filter_map(|cell| {
                    let alternatives = cells.iter().filter(|other| other.case.way.is_alternative());
                    Some((cell, cheapest(alternatives.filter(|other| other.is_beside(cell)), of)?))
                })
                .collect();
            let above: Vec<_> =
                compared.iter().filter(|(cell, alternative)| is_above(cell, alternative, of)).collect();
            verdicts.push(Verdict {
                class: "measurement",
                name: format!("{}, {quantity}: cells above the cheapest socket", way.name()),
                unit: "1",
                ours: vec![above.len() as f64],
                other: Vec::new(),
                target: format!("none of {} above beyond the spread", compared.len()),
                is_met: above.is_empty(),
            });
            verdicts.extend(above.iter().filter_map(|(cell, alternative)| {
                let verdict = Verdict::beside(cell, alternative, (quantity, of), 1.0)?;
                Some(Verdict { class: "above", is_met: false, ..verdict })
            }));
        }
    }
    verdicts
}

/// Returns whether every run of `cell` took more than every run of `other`.
fn is_above(cell: &Cell, other: &Cell, of: Of) -> bool {
    let least = values(cell, of).into_iter().reduce(f64::min);
    let most = values(other, of).into_iter().reduce(f64::max);
    least.zip(most).is_some_and(|(least, most)| least > most)
}

fn cheapest<'a>(cells: impl Iterator<Item = &'a Cell>, of: Of) -> Option<&'a Cell> {
    let known = cells.filter_map(|cell| Some((middle(values(cell, of))?, cell)));
    known.min_by(|(one, _), (other, _)| one.total_cmp(other)).map(|(_, cell)| cell)
}

fn beside<'a>(cell: &Cell, cells: &'a [Cell], way: Way) -> Option<&'a Cell> {
    cells.iter().find(|other| other.case.way == way && other.is_beside(cell))
}

fn middle(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    percentile(&values, 0.5)
}

/// The CPU time of the sender for a message, with and without writing it and waiting until it is due.
const SENDER: [(&str, Of); 2] =
    [("sender's CPU time", |run| Some(run.sender_us)), ("sending alone", |run| run.sending_us)];
/// Maximum length of the hub's own messages.
const SHORT: usize = SCAN;
