//! The tables and the targets of the bench. There is one table for each combination of message length, number of
//! receivers and rate. A target is the maximum cost of topics relative to the baselines or to the cheapest socket.

use serde_json::{Value, json};

use super::message::{Mechanism, PHASES, SCAN_LEN};
use super::run::{Case, PhaseFigures};
use super::{Cell, MEBIBYTE};
use crate::support::Options;
use crate::support::figures::{self, Spread, percentile};

/// Function that returns the value of a figure.
type FigureOf = fn(&PhaseFigures) -> Option<f64>;

/// Prints the machine, and then all tables. With `--json`, prints a line `{class: "machine", bench, machine,
/// processors, runs}` and the most important figures as cells. Then prints a line of class `compared` with all figures
/// for each combination of mechanism, message length, number of receivers and rate.
pub(crate) fn print_tables(options: &Options, processors: usize, pairs: usize, cells: &[Cell]) {
    let digests = cells.iter().flat_map(digests).collect::<Vec<_>>();
    if options.json {
        let line = json!({
            "class": "machine", "bench": "compare", "machine": machine(), "processors": processors, "runs": pairs,
        });
        println!("{line}");
        figures::print_cells("compare", true, &measurable_cells(digests));
        cells.iter().for_each(|cell| println!("{}", comparison_line(cell)));
        return;
    }
    println!("{}, {processors} processors, {pairs} runs each: median [least .. most]", machine());
    println!(
        "With more receivers than processors the last one waits for the others' CPU time, with every mechanism. \
         Datagrams of UDP hold 65507 bytes and those of Unix sockets 65536 here: longer messages are sent in parts. \
         Flat out, streams, pipes and Unix datagrams wait for their receivers, multicast and topics lose."
    );
    figures::print_cells("compare", false, &measurable_cells(cells.iter().flat_map(columns).collect()));
    figures::print_cells("compare", false, &measurable_cells(digests));
}

const LATENCY_FIGURES: [(&str, &str, FigureOf); 6] = [
    ("p50", "us", |run| run.latency[0]),
    ("p99", "us", |run| run.latency[1]),
    ("p99.9", "us", |run| run.latency[2]),
    ("last, p50", "us", |run| run.last[0]),
    ("last, p99", "us", |run| run.last[1]),
    ("last, p99.9", "us", |run| run.last[2]),
];
const COST_FIGURES: [(&str, &str, FigureOf); 6] = [
    ("sender, a message", "us", |run| Some(run.sender_us)),
    ("of it sending", "us", |run| run.sending_us),
    ("receiver, a message", "us", |run| run.receiver_us),
    ("received, a second", "1/s", |run| Some(run.rate_hz)),
    ("missed", "%", |run| Some(run.missed_percent)),
    ("sent, of the rate", "%", |run| run.kept_percent),
];

/// Returns all figures of `cell`, for the tables.
fn columns(cell: &Cell) -> Vec<figures::Cell> {
    let Case { mechanism, payload, receivers } = cell.case;
    let figure = |description: &str, (column, unit, of): (&str, &'static str, FigureOf)| figures::Cell {
        table: format!("{payload} B to {receivers}, {}: {description}", PHASES[cell.phase].name),
        row: mechanism.name().into(),
        column: column.into(),
        unit,
        values: values(cell, of),
    };
    let latency = LATENCY_FIGURES.into_iter().map(|column| figure("latency", column));
    latency.chain(COST_FIGURES.into_iter().map(|column| figure("cost", column))).collect()
}

/// Returns the most important figures of `cell`. There is one column for each number of receivers.
fn digests(cell: &Cell) -> Vec<figures::Cell> {
    const PACED_FIGURES: [(&str, &str, FigureOf); 2] = [
        ("latency of the last receiver, p50", "us", |run| run.last[0]),
        ("CPU time of the sender for a message", "us", |run| Some(run.sender_us)),
    ];
    const UNPACED_FIGURES: [(&str, &str, FigureOf); 1] =
        [("received by each, a second", "1/s", |run| Some(run.rate_hz))];
    let Case { mechanism, payload, receivers } = cell.case;
    let figure = |(description, unit, of): &(&str, &'static str, FigureOf)| figures::Cell {
        table: format!("{payload} B, {}: {description}", PHASES[cell.phase].name),
        row: mechanism.name().into(),
        column: format!("to {receivers}"),
        unit,
        values: values(cell, *of),
    };
    let all: &[_] = if cell.is_paced() { &PACED_FIGURES } else { &UNPACED_FIGURES };
    all.iter().map(figure).collect()
}

/// Returns the cells that could be measured.
fn measurable_cells(mut cells: Vec<figures::Cell>) -> Vec<figures::Cell> {
    cells.retain(|cell| !cell.values.is_empty());
    cells
}

fn comparison_line(cell: &Cell) -> Value {
    let Case { mechanism, payload, receivers } = cell.case;
    let mut line = json!({
        "class": "compared", "bench": "compare", "way": mechanism.name(), "bytes": payload, "receivers": receivers,
        "rate": PHASES[cell.phase].name,
    });
    for (name, unit, of) in LATENCY_FIGURES.into_iter().chain(COST_FIGURES) {
        line[format!("{name}, {unit}")] = json!(Spread::of(&values(cell, of)).map(|spread| spread.json()));
    }
    line
}

/// Returns the figure that `of` selects, for each run that has this figure.
fn values(cell: &Cell, of: FigureOf) -> Vec<f64> {
    cell.runs.iter().filter_map(of).collect()
}

/// Returns the names of the processor and the kernel.
fn machine() -> String {
    let read = |path| std::fs::read_to_string(path).unwrap_or_default();
    let (processor, kernel) = (read("/proc/cpuinfo"), read("/proc/sys/kernel/osrelease"));
    let model = processor.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    format!("{}, Linux {}", model.map_or("unknown processor", |(_, model)| model), kernel.trim())
}

/// Prints the targets of topics relative to the baselines and to the cheapest socket, and whether they are met. With
/// `--json`, prints lines of class `measurement`, whose `baseline` is the mechanism with which topics are compared.
/// Also prints a line of class `above` for each cell in which a socket is cheaper.
pub(crate) fn print_targets(options: &Options, cells: &[Cell]) {
    let mut verdicts = Vec::new();
    for cell in cells.iter().filter(|cell| cell.is_paced()) {
        verdicts.extend(check_waits(cell, cells));
        verdicts.extend(check_spinning(cell, cells));
        verdicts.extend(check_subscriptions(cell, cells));
        verdicts.extend(check_many_receivers(cell, cells));
    }
    verdicts.extend(check_sockets(cells));
    verdicts.iter().for_each(|verdict| verdict.print(options.json));
}

/// A target of a topic, and whether it is met.
struct TargetCheck {
    class: &'static str,
    name: String,
    unit: &'static str,
    /// One value per run.
    topic_values: Vec<f64>,
    /// Values of the mechanism with which the topic is compared, one per run. Empty if the target is an absolute value.
    compared_values: Vec<f64>,
    target: String,
    is_met: bool,
}

impl TargetCheck {
    /// Compares a figure of `cell` with the same figure of `other`. The target is that the figure of `cell` is at most
    /// `max_ratio` times as high.
    fn check_ratio(
        cell: &Cell,
        other: &Cell,
        (quantity, of): (&str, FigureOf),
        max_ratio: f64,
    ) -> Option<TargetCheck> {
        let mut verdict = TargetCheck {
            class: "measurement",
            name: format!("{cell}, {quantity} beside {}", other.case.mechanism.name()),
            unit: "us",
            topic_values: values(cell, of),
            compared_values: values(other, of),
            target: format!("ratio <= {max_ratio}"),
            is_met: false,
        };
        verdict.is_met = median(verdict.ratios())? <= max_ratio;
        Some(verdict)
    }

    /// Returns the ratio for each pair of runs. The two runs of a pair are compared, because they happen within the
    /// same minute.
    fn ratios(&self) -> Vec<f64> {
        self.topic_values.iter().zip(&self.compared_values).map(|(ours, other)| ours / other).collect()
    }

    fn print(&self, as_json: bool) {
        let TargetCheck { class, name, unit, topic_values, compared_values, target, is_met } = self;
        let spreads = [topic_values, compared_values, &self.ratios()].map(|values| Spread::of(values));
        if as_json {
            let [ours, other, ratio] = spreads.map(|spread| spread.map(|spread| spread.json()));
            let line = json!({
                "class": class, "bench": "compare", "name": name, "unit": unit, "runs": self.topic_values.len(),
                "hub": ours, "baseline": other, "ratio": ratio, "target": target, "met": is_met,
            });
            println!("{line}");
        } else {
            let [ours, other, ratio] =
                spreads.map(|spread| spread.map_or("-".into(), |spread| spread.text()));
            let met_text = if *is_met { "met" } else { "MISSED" };
            println!("{name}, {unit}: {ours}; {other}; ratio {ratio}; {target}: {met_text}");
        }
    }
}

/// Compares the wait of a topic with the futex baseline, for messages that are no longer than the hub's messages.
fn check_waits(cell: &Cell, cells: &[Cell]) -> Option<TargetCheck> {
    let maximum = match cell.case.mechanism {
        Mechanism::Doorbell => 1.2,
        Mechanism::Event => 1.5,
        _ => return None,
    };
    if cell.case.receivers > 1 || cell.case.payload > MAX_HUB_MESSAGE_LEN {
        return None;
    }
    TargetCheck::check_ratio(
        cell,
        cell_with_mechanism(cell, cells, Mechanism::FutexBaseline)?,
        ("p50", |run| run.latency[0]),
        maximum,
    )
}

/// Checks the latency of subscribers that spin. The other processors must be idle for this.
fn check_spinning(cell: &Cell, cells: &[Cell]) -> Option<TargetCheck> {
    const MAX_LATENCY_US: f64 = 1.0;
    if cell.case.mechanism != Mechanism::Spin || cell.case.payload > MAX_HUB_MESSAGE_LEN {
        return None;
    }
    let verdict = TargetCheck::check_ratio(
        cell,
        cell_with_mechanism(cell, cells, Mechanism::SpinBaseline)?,
        ("p50", |run| run.latency[0]),
        MAX_LATENCY_US,
    )?;
    let is_met = median(verdict.topic_values.clone())? <= MAX_LATENCY_US;
    Some(TargetCheck {
        target: format!("<= {MAX_LATENCY_US} us where processors are free"),
        is_met,
        ..verdict
    })
}

/// Compares the client library with the topic of bytes that this bench uses for all lengths.
fn check_subscriptions(cell: &Cell, cells: &[Cell]) -> Option<TargetCheck> {
    const COST_FIGURES: (&str, FigureOf) = ("receiver's CPU time", |run| run.receiver_us);
    if cell.case.mechanism != Mechanism::Subscription {
        return None;
    }
    let path = cell_with_mechanism(cell, cells, Mechanism::Doorbell)?;
    let is_met = !is_above(cell, path, COST_FIGURES.1) && !is_above(path, cell, COST_FIGURES.1);
    let verdict = TargetCheck::check_ratio(cell, path, COST_FIGURES, 1.0)?;
    Some(TargetCheck { target: "the same within the spread".into(), is_met, ..verdict })
}

/// Checks the main use of the hub: many receivers of long messages.
fn check_many_receivers(cell: &Cell, cells: &[Cell]) -> Vec<TargetCheck> {
    let times = match cell.case.mechanism {
        Mechanism::Doorbell => 50.0,
        Mechanism::Event => 20.0,
        _ => return Vec::new(),
    };
    if cell.case.receivers != 16 || cell.case.payload != MEBIBYTE {
        return Vec::new();
    }
    let verdict = |(quantity, of): (&str, FigureOf)| {
        let sockets = [Mechanism::UnixDatagram, Mechanism::UnixStream].into_iter();
        let cheapest =
            cheapest(sockets.filter_map(|mechanism| cell_with_mechanism(cell, cells, mechanism)), of)?;
        TargetCheck::check_ratio(cell, cheapest, (quantity, of), 1.0 / times)
    };
    SENDER_FIGURES.into_iter().filter_map(verdict).collect()
}

/// Compares the sender and the last receiver with the cheapest socket. There is one target for all cells together, and
/// another target for each cell in which topics take more time than the socket.
fn check_sockets(cells: &[Cell]) -> Vec<TargetCheck> {
    const LAST_FIGURE: (&str, FigureOf) = ("last receiver's p50", |run| run.last[0]);
    let mut verdicts = Vec::new();
    for mechanism in [Mechanism::Doorbell, Mechanism::Event] {
        for (quantity, of) in SENDER_FIGURES.into_iter().chain([LAST_FIGURE]) {
            let ours = cells.iter().filter(|cell| cell.case.mechanism == mechanism && cell.is_paced());
            let compared: Vec<_> = ours
                .filter_map(|cell| {
                    let alternatives = cells.iter().filter(|other| other.case.mechanism.is_alternative());
                    Some((cell, cheapest(alternatives.filter(|other| other.has_same_load(cell)), of)?))
                })
                .collect();
            let above: Vec<_> =
                compared.iter().filter(|(cell, alternative)| is_above(cell, alternative, of)).collect();
            verdicts.push(TargetCheck {
                class: "measurement",
                name: format!("{}, {quantity}: cells above the cheapest socket", mechanism.name()),
                unit: "1",
                topic_values: vec![above.len() as f64],
                compared_values: Vec::new(),
                target: format!("none of {} above beyond the spread", compared.len()),
                is_met: above.is_empty(),
            });
            verdicts.extend(above.iter().filter_map(|(cell, alternative)| {
                let verdict = TargetCheck::check_ratio(cell, alternative, (quantity, of), 1.0)?;
                Some(TargetCheck { class: "above", is_met: false, ..verdict })
            }));
        }
    }
    verdicts
}

/// Returns whether every run of `cell` took more than every run of `other`.
fn is_above(cell: &Cell, other: &Cell, of: FigureOf) -> bool {
    let minimum = values(cell, of).into_iter().reduce(f64::min);
    let maximum = values(other, of).into_iter().reduce(f64::max);
    minimum.zip(maximum).is_some_and(|(minimum, maximum)| minimum > maximum)
}

fn cheapest<'a>(cells: impl Iterator<Item = &'a Cell>, of: FigureOf) -> Option<&'a Cell> {
    let known = cells.filter_map(|cell| Some((median(values(cell, of))?, cell)));
    known.min_by(|(one, _), (other, _)| one.total_cmp(other)).map(|(_, cell)| cell)
}

fn cell_with_mechanism<'a>(cell: &Cell, cells: &'a [Cell], mechanism: Mechanism) -> Option<&'a Cell> {
    cells.iter().find(|other| other.case.mechanism == mechanism && other.has_same_load(cell))
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    percentile(&values, 0.5)
}

/// CPU time of the sender per message. The first figure includes writing the message and waiting until the message is
/// due. The second figure excludes both.
const SENDER_FIGURES: [(&str, FigureOf); 2] =
    [("sender's CPU time", |run| Some(run.sender_us)), ("sending alone", |run| run.sending_us)];
/// Maximum length of the hub's own messages.
const MAX_HUB_MESSAGE_LEN: usize = SCAN_LEN;
