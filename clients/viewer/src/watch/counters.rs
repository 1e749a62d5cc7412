//! The page of counters: what the links of the shown sensors have counted, a column for each.

use ratatui::layout::Rect;
use ratatui::style::Modifier;
use ratatui::text::Line;
use scanhub_schema::{Counter, Status};

use crate::scene::Sensor;

/// The page for `area`: a heading, the shares of the line, and all counters; as many columns and rows as there is room for.
pub(super) fn page(shown: &[(usize, &Sensor)], area: Rect) -> Vec<Line<'static>> {
    let room = usize::from(area.width).saturating_sub(NAME) / COLUMN;
    let columns = &shown[..shown.len().min(room)];
    let row = |name: &str, value: &dyn Fn(&Sensor) -> String| {
        let cells = columns.iter().map(|(_, sensor)| format!("{:>COLUMN$}", value(sensor)));
        format!("{name:<NAME$}{}", cells.collect::<String>())
    };
    let of = |sensor: &Sensor, value: &dyn Fn(&Status) -> Option<String>| {
        sensor.status.as_ref().and_then(value).unwrap_or_else(|| "-".to_owned())
    };
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let mut lines = vec![Line::styled(row("", &|sensor| short(&sensor.name)), Modifier::BOLD)];
    let shares = [
        row("damaged on the line, last 10 s", &|sensor| {
            of(sensor, &|status| Some(percent(status.damaged())))
        }),
        row("lost on the line, last 10 s", &|sensor| of(sensor, &|status| status.lost_share().map(percent))),
        row("scans this program missed", &|sensor| sensor.lost.to_string()),
    ];
    lines.extend(shares.map(Line::raw));
    // The last line is the measure's.
    let rows = usize::from(area.height).saturating_sub(lines.len() + 1);
    lines.extend(Counter::ALL.iter().take(rows).map(|counter| {
        let value = |status: &Status| Some(status.counters[*counter].to_string());
        Line::raw(row(counter.name(), &|sensor| of(sensor, &value)))
    }));
    lines
}

/// As much of a name as a column has room for: its end, which tells sensors of one machine apart.
fn short(name: &str) -> String {
    let excess = name.chars().count().saturating_sub(COLUMN - 1);
    name.chars().skip(excess).collect()
}

const NAME: usize = 32;
const COLUMN: usize = 14;
