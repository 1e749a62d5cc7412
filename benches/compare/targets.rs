//! What topics should cost beside the floors and beside the cheapest socket, and whether they do. Refuses to fail because
//! of it: figures are the machine's too.

use serde_json::json;

use super::message::SCAN;
use super::table::{Of, values};
use super::way::Way;
use super::{Cell, MEBIBYTE};
use crate::support::figures::{Spread, percentile};
use crate::support::options::Options;

/// Prints each, and where it is missed. With `--json` as lines of class `measurement`, whose floor is what topics are
/// compared with, and of class `above`, for each cell where a socket is cheaper.
pub(crate) fn print(options: &Options, cells: &[Cell]) {
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

struct Verdict {
    class: &'static str,
    name: String,
    unit: &'static str,
    /// One value per run.
    ours: Vec<f64>,
    /// One value per run of what it is compared with; empty if it is not.
    other: Vec<f64>,
    target: String,
    is_met: bool,
}

impl Verdict {
    /// `cell` beside `other`, of which it should take `most` times as much at most.
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

    /// Run by run, for those met one another within the same minute.
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
                "hub": ours, "floor": other, "ratio": ratio, "target": target, "met": is_met,
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

/// A wait of topics beside the bare futex, with messages as short as the hub's.
fn of_waits(cell: &Cell, cells: &[Cell]) -> Option<Verdict> {
    let most = match cell.case.way {
        Way::Doorbell => 1.2,
        Way::Event => 1.5,
        _ => return None,
    };
    if cell.case.receivers > 1 || cell.case.payload > SHORT {
        return None;
    }
    Verdict::beside(cell, beside(cell, cells, Way::FutexFloor)?, ("p50", |run| run.latency[0]), most)
}

/// Spinning, where two processors have nothing else to do.
fn of_spinning(cell: &Cell, cells: &[Cell]) -> Option<Verdict> {
    const MOST_US: f64 = 1.0;
    if cell.case.way != Way::Spin || cell.case.payload > SHORT {
        return None;
    }
    let verdict =
        Verdict::beside(cell, beside(cell, cells, Way::SpinFloor)?, ("p50", |run| run.latency[0]), MOST_US)?;
    let is_met = middle(verdict.ours.clone())? <= MOST_US;
    Some(Verdict { target: format!("<= {MOST_US} us where processors are free"), is_met, ..verdict })
}

/// The client library beside the path that is used for all lengths here.
fn of_subscriptions(cell: &Cell, cells: &[Cell]) -> Option<Verdict> {
    const COST: (&str, Of) = ("receiver's processor time", |run| run.receiver_us);
    if cell.case.way != Way::Subscription {
        return None;
    }
    let path = beside(cell, cells, Way::Doorbell)?;
    let is_met = !is_above(cell, path, COST.1) && !is_above(path, cell, COST.1);
    let verdict = Verdict::beside(cell, path, COST, 1.0)?;
    Some(Verdict { target: "the same within the spread".into(), is_met, ..verdict })
}

/// What the hub is for: many receivers of long messages.
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

/// Sender and last receiver beside the cheapest socket: a verdict for all cells together, then one for each where they are
/// above it.
fn of_sockets(cells: &[Cell]) -> Vec<Verdict> {
    const LAST: (&str, Of) = ("last receiver's p50", |run| run.last[0]);
    let mut verdicts = Vec::new();
    for way in [Way::Doorbell, Way::Event] {
        for (quantity, of) in SENDER.into_iter().chain([LAST]) {
            let ours = cells.iter().filter(|cell| cell.case.way == way && cell.is_paced());
            let compared: Vec<_> = ours
                .filter_map(|cell| {
                    let rivals = cells.iter().filter(|rival| rival.case.way.is_rival());
                    Some((cell, cheapest(rivals.filter(|rival| rival.is_beside(cell)), of)?))
                })
                .collect();
            let above: Vec<_> = compared.iter().filter(|(cell, rival)| is_above(cell, rival, of)).collect();
            verdicts.push(Verdict {
                class: "measurement",
                name: format!("{}, {quantity}: cells above the cheapest socket", way.name()),
                unit: "1",
                ours: vec![above.len() as f64],
                other: Vec::new(),
                target: format!("none of {} above beyond the spread", compared.len()),
                is_met: above.is_empty(),
            });
            verdicts.extend(above.iter().filter_map(|(cell, rival)| {
                let verdict = Verdict::beside(cell, rival, (quantity, of), 1.0)?;
                Some(Verdict { class: "above", is_met: false, ..verdict })
            }));
        }
    }
    verdicts
}

/// Every run of `cell` took more than every run of `other`.
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

/// With all that a message costs its sender, and without the writing of it and the wait until it is due.
const SENDER: [(&str, Of); 2] =
    [("sender's processor time", |run| Some(run.sender_us)), ("sending alone", |run| run.sending_us)];
/// The hub's own messages are not longer.
const SHORT: usize = SCAN;
