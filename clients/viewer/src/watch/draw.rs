//! Screen of a scene: the verdict as text, the picture or the counters, a line per sensor, and the keys. The same scene
//! and view always give the same cells.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Clear, Paragraph};

use scanhub_schema::{Counter, Status};

use super::map::{DOTS_PER_CELL, color, map};
use super::view::View;
use crate::scene::{PointerPosition, Scene, Sensor, rooms, verdict};

/// Draws `scene` with the settings in `view`. If the picture is frozen, the picture shows `held`. The verdict and the
/// lines of sensors always come from `scene`.
pub(crate) fn draw(frame: &mut Frame<'_>, scene: &Scene, held: Option<&Scene>, view: &View) {
    let areas = ScreenAreas::of(frame.area(), scene);
    let heading = heading(scene, view, areas.heading.width);
    let fits = |hub: &Line<'_>| heading.width() + hub.width() <= width(areas.heading);
    if let Some(hub) = hub_states(scene).into_iter().find(fits) {
        let area = right(areas.heading, hub.width());
        frame.render_widget(hub, area);
    }
    frame.render_widget(heading, areas.heading);
    let pictured = held.unwrap_or(scene);
    if view.counters {
        frame.render_widget(Paragraph::new(counters(&view.shown(scene), areas.map)), areas.map);
    } else {
        frame.render_widget(map(pictured, view, (areas.map.width, areas.map.height)), areas.map);
        let scale_bar = scale_bar(view.dot_m);
        let room = width(areas.map).saturating_sub(scale_bar.chars().count() + 2);
        let text = pointer_text(pictured, view, room);
        let area = right(last_row(areas.map), text.chars().count());
        frame.render_widget(Line::raw(scale_bar), last_row(areas.map));
        frame.render_widget(Line::raw(text), area);
    }
    for (row, (number, sensor)) in areas.sensors.rows().zip(listed(scene, view, areas.sensors.height)) {
        frame.render_widget(line(number, sensor, view, row.width), row);
    }
    let keys = match (view.message.as_str(), view.note.as_str()) {
        ("", "") => Line::raw(KEYS),
        ("", note) => Line::raw(format!("{FEW_KEYS}  {note}")),
        (message, _) => Line::raw(message.to_owned()),
    };
    frame.render_widget(keys.patch_style(Modifier::DIM), areas.keys);
    if view.help {
        help(frame, areas.map);
    }
}

/// Returns the area of the picture on a screen of `area`.
pub(super) fn map_area(area: Rect, scene: &Scene) -> Rect {
    ScreenAreas::of(area, scene).map
}

/// Areas of the screen.
struct ScreenAreas {
    heading: Rect,
    map: Rect,
    sensors: Rect,
    keys: Rect,
}

impl ScreenAreas {
    fn of(area: Rect, scene: &Scene) -> ScreenAreas {
        let row = |from: u16, rows: u16| {
            let y = area.y + from.min(area.height);
            Rect { y, height: rows.min(area.bottom() - y), ..area }
        };
        // The picture has priority, so on a small screen not every sensor has a line.
        let needed = u16::try_from(scene.sensors.len()).unwrap_or(u16::MAX);
        let sensors = needed.min(area.height / 4);
        let map = area.height.saturating_sub(2 + sensors);
        ScreenAreas {
            heading: row(0, 1),
            map: row(1, map),
            sensors: row(1 + map, sensors),
            keys: row(1 + map + sensors, 1),
        }
    }
}

/// Returns the verdict and the smallest distance as text, because not everyone can distinguish colors. A part that does
/// not fit is omitted completely, because a truncated number looks like another number.
fn heading(scene: &Scene, view: &View, columns: u16) -> Line<'static> {
    let shown = view.shown(scene);
    let (verdict, sensor, nearest) = verdict(shown.iter().map(|(_, sensor)| *sensor));
    let mut style = Style::new().add_modifier(Modifier::BOLD | Modifier::REVERSED);
    if view.colors {
        style = style.fg(color(verdict));
    }
    let mut spans = vec![Span::styled(format!(" {} ", verdict.name().to_uppercase()), style)];
    if view.paused {
        spans.push(Span::styled(" HELD ", Modifier::REVERSED));
    }
    if let Some(sensor) = sensor {
        spans.push(Span::raw(format!(" {sensor}")));
    }
    if let Some(mm) = nearest {
        spans.push(Span::raw(format!(", nearest {:.2} m", f64::from(mm) / 1000.0)));
    }
    if let Some(rooms) = rooms(scene.people()) {
        spans.push(Span::raw(format!("  {rooms}")));
    }
    while spans.len() > 1 && spans.iter().map(Span::width).sum::<usize>() > usize::from(columns) {
        spans.pop();
    }
    Line::from(spans)
}

/// Returns the state of the hub as text, the longest form first.
fn hub_states(scene: &Scene) -> Vec<Line<'static>> {
    let percent = scene.hub_percent.map(|percent| format!(" {percent:.1} %")).unwrap_or_default();
    let words = match (scene.hub_is_running, scene.hub_pid) {
        (false, _) => {
            return [" no hub: waiting for it", " no hub"]
                .map(|text| Line::styled(text, Modifier::BOLD))
                .into();
        }
        (true, 0) => vec![" hub".to_owned()],
        (true, pid) => vec![format!(" hub {pid}{percent}"), format!(" hub {pid}")],
    };
    words.into_iter().map(Line::raw).collect()
}

/// Returns the sensors whose lines fit in `rows`. If not all fit, starts at the selected sensor.
fn listed<'a>(scene: &'a Scene, view: &View, rows: u16) -> impl Iterator<Item = (usize, &'a Sensor)> {
    let hidden = scene.sensors.len().saturating_sub(usize::from(rows));
    let first = view.only_sensor.unwrap_or(0).min(hidden);
    scene.sensors.iter().enumerate().skip(first)
}

/// Returns the line of a sensor, with the most important parts first. A part that does not fit is omitted completely.
fn line(number: usize, sensor: &Sensor, view: &View, width: u16) -> Line<'static> {
    let dash = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
    let hz = dash(sensor.meter.hz().map(|hz| format!("{hz:.1}")));
    let age = dash(sensor.meter.age_ms().map(|(mean, _)| format!("{mean:.2}")));
    let max_age = dash(sensor.meter.age_ms().map(|(_, max)| format!("{max:.2}")));
    let mut text = format!("{} {:<8} {:<9}", number + 1, sensor.name, sensor.state());
    let loss = sensor.status.and_then(|status| status.line_loss());
    let error = sensor.status.map(|status| status.last_error().to_owned()).unwrap_or_default();
    if sensor.scan.is_none() && !error.is_empty() {
        text += &format!(" {error}");
    } else {
        let mut fields = vec![format!(" {hz:>5} Hz")];
        fields.extend(loss.iter().map(|loss| format!("  {loss}")));
        fields.extend([format!(" {age:>5} ms"), format!("  missed {}", sensor.missed)]);
        if sensor.is_frozen() {
            fields.push("  frozen".to_owned());
        }
        fields.push(format!("  suspect {}", sensor.count(Counter::Suspect)));
        if width >= MIN_WIDE_COLUMNS {
            let known_beams = sensor.background.as_ref().map_or(0, |model| model.known_beams);
            let marks = sensor.marks.map(|marks| marks.marks().len().to_string());
            let objects =
                sensor.foreground.as_ref().map(|foreground| foreground.segments().len().to_string());
            fields.extend([format!("  max {max_age} ms"), format!("  marks {}", dash(marks))]);
            fields.extend([format!("  objects {}", dash(objects)), format!("  background {known_beams}")]);
        }
        append_fitting(&mut text, fields, "", usize::from(width));
    }
    let is_shown = view.only_sensor.is_none_or(|only| only == number);
    let mut style = if is_shown { Style::new() } else { Style::new().add_modifier(Modifier::DIM) };
    if loss.is_some() {
        style = style.add_modifier(Modifier::BOLD);
    }
    Line::styled(text, style)
}

/// Returns the counters of the links for `area`: a heading, the shares of data that was damaged and lost on the line,
/// and all counters. Each of the `shown` sensors has a column. Columns and rows that do not fit are omitted.
fn counters(shown: &[(usize, &Sensor)], area: Rect) -> Vec<Line<'static>> {
    let room = usize::from(area.width).saturating_sub(NAME_WIDTH) / COLUMN_WIDTH;
    let columns = &shown[..shown.len().min(room)];
    let row = |name: &str, value: &dyn Fn(&Sensor) -> String| {
        let cells = columns.iter().map(|(_, sensor)| format!("{:>COLUMN_WIDTH$}", value(sensor)));
        format!("{name:<NAME_WIDTH$}{}", cells.collect::<String>())
    };
    let of = |sensor: &Sensor, value: &dyn Fn(&Status) -> Option<String>| {
        sensor.status.as_ref().and_then(value).unwrap_or_else(|| "-".to_owned())
    };
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let mut lines = vec![Line::styled(row("", &|sensor| short_name(&sensor.name)), Modifier::BOLD)];
    let shares = [
        row("damaged on the line, last 10 s", &|sensor| {
            of(sensor, &|status| Some(percent(status.damaged_share())))
        }),
        row("lost on the line, last 10 s", &|sensor| of(sensor, &|status| status.lost_share().map(percent))),
        row("scans this program missed", &|sensor| sensor.missed.to_string()),
    ];
    lines.extend(shares.map(Line::raw));
    // Leave the last row empty. In the picture, it has the scale bar.
    let rows = usize::from(area.height).saturating_sub(lines.len() + 1);
    lines.extend(Counter::ALL.iter().take(rows).map(|counter| {
        let value = |status: &Status| Some(status.counters[*counter].to_string());
        Line::raw(row(counter.name(), &|sensor| of(sensor, &value)))
    }));
    lines
}

/// Returns as much of the end of a name as fits in a column. The end distinguishes the sensors of one machine.
fn short_name(name: &str) -> String {
    let excess = name.chars().count().saturating_sub(COLUMN_WIDTH - 1);
    name.chars().skip(excess).collect()
}

/// Returns a scale bar with a round length: `|----| 1 m`.
fn scale_bar(dot_m: f64) -> String {
    let cell_m = dot_m * DOTS_PER_CELL.0;
    let length = LENGTHS_M.into_iter().rev().find(|length| length / cell_m <= SCALE_BAR_CELLS);
    let length = length.unwrap_or(LENGTHS_M[0]);
    let cells = (length / cell_m).round().clamp(2.0, 4.0 * SCALE_BAR_CELLS) as usize;
    format!("|{}| {length} m", "-".repeat(cells - 2))
}

/// Returns the text about the position of the pointer in at most `room` columns, or no text without a pointer. A part
/// that does not fit is omitted completely.
fn pointer_text(scene: &Scene, view: &View, room: usize) -> String {
    let Some(at) = view.pointer_m else { return String::new() };
    let shown = view.shown(scene);
    let position = PointerPosition::of(
        shown.iter().map(|(_, sensor)| *sensor),
        at,
        MAX_POINTER_DISTANCE_DOTS * view.dot_m,
    );
    let mut text = String::new();
    append_fitting(&mut text, position.text_lines(), ", ", room);
    text
}

/// Appends `parts`, separated by `between`, until a part does not fit. `text` has at most `room` columns.
fn append_fitting(text: &mut String, parts: Vec<String>, between: &str, room: usize) {
    for part in parts {
        let between = if text.is_empty() { "" } else { between };
        if text.chars().count() + between.len() + part.chars().count() > room {
            break;
        }
        text.extend([between, &part]);
    }
}

fn help(frame: &mut Frame<'_>, area: Rect) {
    let lines: Vec<Line<'_>> = HELP.lines().map(Line::raw).collect();
    let width = lines.iter().map(Line::width).max().unwrap_or_default() as u16 + 2;
    let (width, height) = (width.min(area.width), (lines.len() as u16 + 2).min(area.height));
    let (x, y) = (area.x + (area.width - width) / 2, area.y + (area.height - height) / 2);
    let rect = Rect { x, y, width, height };
    frame.render_widget(Clear, rect);
    frame.render_widget(Paragraph::new(lines).block(Block::bordered().title(" scanhub watch ")), rect);
}

fn right(row: Rect, width: usize) -> Rect {
    let width = row.width.min(width as u16);
    Rect { x: row.right() - width, width, ..row }
}

fn width(area: Rect) -> usize {
    usize::from(area.width)
}

fn last_row(area: Rect) -> Rect {
    let height = area.height.min(1);
    Rect { y: area.bottom() - height, height, ..area }
}

const FEW_KEYS: &str = "q quit  ? help";
const KEYS: &str = "q quit  ? help  +- zoom  x read  n counters  space freeze";

/// Meaning of keys and signs, in at most 60 columns and 16 rows.
const HELP: &str = "\
+ - wheel, hjkl, c    zoom, pan, fit
tab  0 1 2 ..         next sensor, all, one of them
f b m z               foreground, background, marks, zones
t g i e               trails, grid, intensity, lines
x, arrows; mouse      read what is there    n counters
space                 freeze
R  F                  background: reset; freeze, thaw
? q Esc Ctrl-C        this help, quit

dots  where a beam hit something; small gray: background
o ,   foreground, its trail (in color instead of signs)
* @   reflector mark, corner   ^ 1 2 robot, sensors
0.60! circle around the robot, in m, with something inside";

/// Width of the names of counters.
const NAME_WIDTH: usize = 32;
/// Width of the column of a sensor.
const COLUMN_WIDTH: usize = 14;
/// Maximum distance between the pointer and a point whose reading is shown, in dots.
const MAX_POINTER_DISTANCE_DOTS: f64 = 6.0;
/// Minimum number of columns for the line of a sensor with all fields.
const MIN_WIDE_COLUMNS: u16 = 100;
const LENGTHS_M: [f64; 9] = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0];
/// Maximum length of the scale bar, in cells.
const SCALE_BAR_CELLS: f64 = 12.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scale_bars_are_round_and_short() {
        assert_eq!(scale_bar(0.05), "|--------| 1 m");
        assert_eq!(scale_bar(0.001), "|".to_owned() + &"-".repeat(48).as_str()[..46] + "| 0.1 m");
        assert_eq!(scale_bar(1.0), "|--------| 20 m");
    }
}
