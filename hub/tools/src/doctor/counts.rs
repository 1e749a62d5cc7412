//! What the driver of a line counted: bytes that arrived damaged, or were lost before they could be read. At a wrong rate
//! every byte is an error, and a search for a sensor tries wrong rates: a few errors are no finding.

use port::Counts;
use schema::{Counter, Status};

use super::finding::Finding;
use crate::listen::MOST_DAMAGED;

const NAME: &str = "line-errors";

/// Judges what an open line's driver counted since it was loaded, if it counts, and how many errors of it came `now`, while
/// a sensor answered at its rate.
pub(crate) fn line_errors(counts: Option<Counts>, now: u64) -> Finding {
    let Some(counts) = counts else { return Finding::skipped(NAME, "the driver does not count errors") };
    let Counts { received, framing, overrun, parity, breaks, buffer } = counts;
    let text = format!(
        "framing {framing}, parity {parity}, breaks {breaks}, overruns {} in {received} bytes since its driver was loaded",
        overrun.wrapping_add(buffer)
    );
    let lost = overrun.wrapping_add(buffer);
    if now > FEW {
        return Finding::warning(
            NAME,
            format!("{now} errors while the sensor answered; {text}"),
            remedy(false),
        );
    }
    if is_large(lost.into(), received.into()) {
        return Finding::warning(NAME, text, remedy(true));
    }
    if is_large(counts.errors().into(), received.into()) {
        return Finding::warning(NAME, text, remedy(false));
    }
    Finding::ok(NAME, text)
}

/// Judges what the hub says of a port that it has.
pub(crate) fn as_the_hub_counts(status: &Status) -> Finding {
    let (errors, bytes) = (status.counters[Counter::LineErrors], status.counters[Counter::BytesRead]);
    let text = format!("the hub counted {errors} in {bytes} bytes");
    if is_large(errors, bytes) {
        Finding::warning(NAME, text, remedy(false))
    } else {
        Finding::ok(NAME, text)
    }
}

/// Judges what a line of the hub takes away of its stream.
pub(crate) fn line_loss(status: &Status) -> Finding {
    const NAME: &str = "line-loss";
    let due = status.counters[Counter::DueOnLine];
    let all = match status.lost_on_line() {
        // Those that are damaged are missing, too, but too little arrives to count them.
        Some(0) if is_mostly_damaged(status) => format!("how many {} are lost is not known", status.sent()),
        Some(lost) => format!("{lost} of {due} {} lost since the hub's start", status.sent()),
        None => format!("how many {} are lost is not known", status.sent()),
    };
    let text = format!("{:.2} % of the bytes damaged in the last 10 s, {all}", 100.0 * status.damaged());
    match status.line_loss() {
        Some(loss) if is_mostly_damaged(status) => {
            Finding::failed(NAME, format!("{loss}; {text}"), LOSS_REMEDY)
        }
        Some(loss) => Finding::warning(NAME, format!("{loss}; {text}"), LOSS_REMEDY),
        None => Finding::ok(NAME, text),
    }
}

/// Returns whether the line damages most bytes, which makes every conclusion from the others unreliable.
pub(crate) fn is_mostly_damaged(status: &Status) -> bool {
    status.damaged() > MOST_DAMAGED
}

fn is_large(errors: u64, bytes: u64) -> bool {
    errors > SOME && errors.saturating_mul(OF_BYTES) > bytes
}

fn remedy(is_lost: bool) -> &'static str {
    if is_lost {
        "the machine did not fetch them in time: another USB socket, without a hub in between; a UART with a FIFO"
    } else {
        "the cable: ground, twisted pairs, 120 ohm across the receiving pair, away from motors; docs/wiring.md"
    }
}

/// Remedy for a line that takes bytes away.
pub(crate) const LOSS_REMEDY: &str = "the cable and its ground; the adapter: one with an FT232R or newer, in a socket of the \
     machine; of a UART its FIFO (setserial -g); 120 ohm of termination at the receiving end; docs/wiring.md";
/// A byte that was cut when the rate changed, and one more.
const FEW: u64 = 2;
/// Looking for the rates of sensors makes some.
const SOME: u64 = 1000;
/// One of so many bytes: one telegram of ten.
const OF_BYTES: u64 = 7000;

#[cfg(test)]
mod tests {
    use super::super::finding::State;
    use super::*;

    #[test]
    fn errors_are_judged_by_when_and_how_many() {
        let healthy = Counts { received: 100_000_000, framing: 900, ..Counts::default() };
        let of = |counts: Counts, now| line_errors(Some(counts), now);
        assert_eq!(line_errors(None, 0).state, State::Skipped);
        assert_eq!(of(healthy, 0).state, State::Ok);
        assert_eq!(of(healthy, FEW).state, State::Ok);
        let grown = of(healthy, 40);
        assert!(grown.state == State::Warning && grown.finding.starts_with("40 errors while"), "{grown}");
        assert!(grown.remedy.contains("120 ohm"), "{grown}");
        let large = of(Counts { parity: 90_000, ..healthy }, 0);
        assert!(large.state == State::Warning && large.remedy.contains("cable"), "{large}");
        let lost = of(Counts { overrun: 10_000, buffer: 80_000, ..healthy }, 0);
        assert!(lost.state == State::Warning && lost.remedy.contains("FIFO"), "{lost}");
        assert!(lost.finding.contains("overruns 90000 in 100000000 bytes"), "{lost}");
    }

    #[test]
    fn a_line_that_loses_more_than_a_thousandth_is_told() {
        let mut status = Status::default();
        assert_eq!(line_loss(&status).state, State::Ok);
        status.counters[Counter::DueOnLine] = 22_000;
        status.counters[Counter::LostOnLine] = 9_000;
        let past = line_loss(&status);
        assert!(past.state == State::Ok && past.finding.contains("9000 of 22000 scans lost"), "{past}");
        status.counters[Counter::LostPpm] = 408_000;
        status.counters[Counter::DamagedPpm] = 430_000;
        let now = line_loss(&status);
        assert!(now.state == State::Warning && now.finding.starts_with("41 % lost on the line"), "{now}");
        status.counters[Counter::DamagedPpm] = 510_000;
        let most = line_loss(&status);
        assert_eq!(most.state, State::Failed, "as of a port that no hub has: {most}");
        status.counters[Counter::LostOnLine] = 0;
        status.counters[Counter::LostPpm] = 0;
        let unknown = line_loss(&status).finding;
        assert!(unknown.ends_with("how many scans are lost is not known"), "{unknown}");
        for word in ["cable", "FIFO", "adapter", "termination"] {
            assert!(now.remedy.contains(word), "{now}");
        }
    }

    #[test]
    fn the_hubs_count_is_judged_by_its_bytes() {
        let mut status = Status::default();
        status.counters[Counter::BytesRead] = 1_000_000;
        status.counters[Counter::LineErrors] = 10;
        assert_eq!(as_the_hub_counts(&status).state, State::Ok);
        status.counters[Counter::LineErrors] = 5000;
        assert_eq!(as_the_hub_counts(&status).state, State::Warning);
    }
}
