//! What topics should cost beside the floors and beside the cheapest socket, and whether they do. Refuses to fail because
//! of it: figures are the machine's too.

use serde_json::json;

use super::Cell;
use super::schedule::PHASES;
use super::table::{Of, values};
use super::way::Way;
use crate::support::figures::percentile;
use crate::support::options::Options;

/// Prints each, and where it is missed.
pub(crate) fn print(options: &Options, cells: &[Cell]) {
    let mut verdicts = Vec::new();
    for cell in cells.iter().filter(|cell| is_paced(cell)) {
        verdicts.extend(of_waits(cell, cells));
        verdicts.extend(of_spinning(cell));
        verdicts.extend(of_attaching(cell, cells));
        verdicts.extend(of_many(cell, cells));
    }
    verdicts.extend(of_sockets(cells));
    for Verdict { what, target, value, is_met } in verdicts {
        if options.json {
            println!(
                "{}",
                json!({ "class": "target", "bench": "compare", "what": what, "target": target, "value": value, "met": is_met })
            );
        } else {
            let met = if is_met { "met" } else { "MISSED" };
            println!("{what}: {value}; {target}: {met}");
        }
    }
}

struct Verdict {
    what: String,
    target: String,
    value: String,
    is_met: bool,
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
    ratio(
        cell,
        beside(cell, cells, Way::FutexFloor)?,
        "p50",
        |run| run.latency[0],
        |ratio| ratio <= most,
        &format!("<= {most}"),
    )
}

fn of_spinning(cell: &Cell) -> Option<Verdict> {
    if cell.case.way != Way::Spin || cell.case.payload > SHORT {
        return None;
    }
    let value = median(cell, |run| run.latency[0])?;
    Some(Verdict {
        what: format!("{}, p50", name(cell)),
        target: "<= 1 us where processors are free".into(),
        value: format!("{value:.2} us"),
        is_met: value <= 1.0,
    })
}

/// The attach library beside the path that is used for all lengths here.
fn of_attaching(cell: &Cell, cells: &[Cell]) -> Option<Verdict> {
    if cell.case.way != Way::Attachment {
        return None;
    }
    let path = beside(cell, cells, Way::Doorbell)?;
    let is_same =
        !is_above(cell, path, |run| run.receiver_us) && !is_above(path, cell, |run| run.receiver_us);
    ratio(
        cell,
        path,
        "receiver's processor time",
        |run| run.receiver_us,
        |_| is_same,
        "the same within the spread",
    )
}

/// What the hub is for: many receivers of long messages.
fn of_many(cell: &Cell, cells: &[Cell]) -> Vec<Verdict> {
    let least = match cell.case.way {
        Way::Doorbell => 50.0,
        Way::Event => 20.0,
        _ => return Vec::new(),
    };
    if cell.case.receivers != 16 || cell.case.payload != super::MEBIBYTE {
        return Vec::new();
    }
    let verdict = |(quantity, of): (&str, Of)| {
        let sockets = [Way::UnixDatagram, Way::UnixStream].into_iter();
        let cheapest = cheapest(sockets.filter_map(|way| beside(cell, cells, way)), of)?;
        ratio(cheapest, cell, quantity, of, |ratio| ratio >= least, &format!(">= {least}"))
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
            let ours = cells.iter().filter(|cell| cell.case.way == way && is_paced(cell));
            let beside: Vec<_> = ours
                .filter_map(|cell| {
                    let rivals = cells.iter().filter(|rival| rival.case.way.is_rival());
                    Some((cell, cheapest(rivals.filter(|rival| is_beside(rival, cell)), of)?))
                })
                .collect();
            let above: Vec<_> = beside.iter().filter(|(cell, rival)| is_above(cell, rival, of)).collect();
            let target = "not above the cheapest socket beyond the spread";
            verdicts.push(Verdict {
                what: format!("{}, {quantity}", way.name()),
                target: target.into(),
                value: format!("above it in {} of {} cells", above.len(), beside.len()),
                is_met: above.is_empty(),
            });
            verdicts.extend(
                above.iter().filter_map(|(cell, rival)| ratio(cell, rival, quantity, of, |_| false, target)),
            );
        }
    }
    verdicts
}

/// The ratio run by run, which met one another within the same minute.
fn ratio(
    cell: &Cell,
    other: &Cell,
    quantity: &str,
    of: Of,
    is_met: impl Fn(f64) -> bool,
    target: &str,
) -> Option<Verdict> {
    let mut ratios: Vec<f64> =
        values(cell, of).iter().zip(values(other, of)).map(|(value, other)| value / other).collect();
    ratios.sort_by(f64::total_cmp);
    let ratio = percentile(&ratios, 0.5)?;
    let (value, beside) = (median(cell, of)?, median(other, of)?);
    Some(Verdict {
        what: format!("{}, {quantity} beside {}", name(cell), other.case.way.name()),
        target: target.into(),
        value: format!(
            "{value:.2} and {beside:.2} us, ratio {ratio:.2} [{:.2} .. {:.2}]",
            ratios[0],
            ratios[ratios.len() - 1]
        ),
        is_met: is_met(ratio),
    })
}

/// Every run of `cell` took more than every run of `other`.
fn is_above(cell: &Cell, other: &Cell, of: Of) -> bool {
    let least = values(cell, of).into_iter().reduce(f64::min);
    let most = values(other, of).into_iter().reduce(f64::max);
    least.zip(most).is_some_and(|(least, most)| least > most)
}

fn cheapest<'a>(cells: impl Iterator<Item = &'a Cell>, of: Of) -> Option<&'a Cell> {
    let known = cells.filter_map(|cell| Some((median(cell, of)?, cell)));
    known.min_by(|(one, _), (other, _)| one.total_cmp(other)).map(|(_, cell)| cell)
}

fn beside<'a>(cell: &Cell, cells: &'a [Cell], way: Way) -> Option<&'a Cell> {
    cells.iter().find(|other| other.case.way == way && is_beside(other, cell))
}

fn is_beside(one: &Cell, other: &Cell) -> bool {
    let place = |cell: &Cell| (cell.case.payload, cell.case.receivers, cell.phase);
    place(one) == place(other)
}

fn is_paced(cell: &Cell) -> bool {
    PHASES[cell.phase].period_ns > 0
}

fn median(cell: &Cell, of: Of) -> Option<f64> {
    let mut values = values(cell, of);
    values.sort_by(f64::total_cmp);
    percentile(&values, 0.5)
}

fn name(cell: &Cell) -> String {
    let case = cell.case;
    format!("{}, {} B to {}, {}", case.way.name(), case.payload, case.receivers, PHASES[cell.phase].name)
}

/// With all that a message costs its sender, and without the writing of it and the wait until it is due.
const SENDER: [(&str, Of); 2] =
    [("sender's processor time", |run| Some(run.sender_us)), ("sending alone", |run| run.sending_us)];
/// The hub's own messages are not longer.
const SHORT: usize = size_of::<schema::Scan>();
