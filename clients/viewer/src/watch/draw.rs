//! Draws a scene: the verdict in words, the picture, a line per sensor, and the keys. Pure: the same scene and view
//! give the same cells. Refuses to know what is on the screen.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Clear, Paragraph};

use scanhub_schema::Counter;

use super::counters::page;
use super::map::{DOTS, colour, map};
use super::view::View;
use crate::scene::{PointerPosition, Scene, Sensor, rooms, verdict};

/// Draws `scene` as `view` says, with the picture of `held` if that is there: what there is to act on is never held.
pub(crate) fn draw(frame: &mut Frame<'_>, scene: &Scene, held: Option<&Scene>, view: &View) {
    let places = Places::of(frame.area(), scene);
    let heading = heading(scene, view, places.heading.width);
    if let Some(over) =
        over(scene).into_iter().find(|over| heading.width() + over.width() <= width(places.heading))
    {
        let place = right(places.heading, over.width());
        frame.render_widget(over, place);
    }
    frame.render_widget(heading, places.heading);
    let pictured = held.unwrap_or(scene);
    if view.counters {
        frame.render_widget(Paragraph::new(page(&view.shown(scene), places.map)), places.map);
    } else {
        frame.render_widget(map(pictured, view, (places.map.width, places.map.height)), places.map);
        let measure = measure(view.dot_m);
        let room = width(places.map).saturating_sub(measure.chars().count() + 2);
        let said = words(pictured, view, room);
        let place = right(last_row(places.map), said.chars().count());
        frame.render_widget(Line::raw(measure), last_row(places.map));
        frame.render_widget(Line::raw(said), place);
    }
    for (row, (number, sensor)) in places.sensors.rows().zip(listed(scene, view, places.sensors.height)) {
        frame.render_widget(line(number, sensor, view, row.width), row);
    }
    let keys = match (view.news.as_str(), view.note.as_str()) {
        ("", "") => Line::raw(KEYS),
        ("", note) => Line::raw(format!("{FEW_KEYS}  {note}")),
        (news, _) => Line::raw(news.to_owned()),
    };
    frame.render_widget(keys.patch_style(Modifier::DIM), places.keys);
    if view.help {
        help(frame, places.map);
    }
}

/// Where the picture is on a screen of `area`.
pub(crate) fn place_of_map(area: Rect, scene: &Scene) -> Rect {
    Places::of(area, scene).map
}

/// Where things are on the screen.
struct Places {
    heading: Rect,
    map: Rect,
    sensors: Rect,
    keys: Rect,
}

impl Places {
    fn of(area: Rect, scene: &Scene) -> Places {
        let row = |from: u16, rows: u16| {
            let y = area.y + from.min(area.height);
            Rect { y, height: rows.min(area.bottom() - y), ..area }
        };
        // The picture comes first: on a low screen not all sensors have a line.
        let wanted = u16::try_from(scene.sensors.len()).unwrap_or(u16::MAX);
        let sensors = wanted.min(area.height / 4);
        let map = area.height.saturating_sub(2 + sensors);
        Places {
            heading: row(0, 1),
            map: row(1, map),
            sensors: row(1 + map, sensors),
            keys: row(1 + map + sensors, 1),
        }
    }
}

/// The verdict, and what is nearest; in words, because colours say nothing to everybody. What has no room is left out whole:
/// a number that is cut is another number.
fn heading(scene: &Scene, view: &View, columns: u16) -> Line<'static> {
    let shown = view.shown(scene);
    let (verdict, whose, nearest) = verdict(shown.iter().map(|(_, sensor)| *sensor));
    let mut style = Style::new().add_modifier(Modifier::BOLD | Modifier::REVERSED);
    if view.colours {
        style = style.fg(colour(verdict));
    }
    let mut spans = vec![Span::styled(format!(" {} ", verdict.name().to_uppercase()), style)];
    if view.paused {
        spans.push(Span::styled(" HELD ", Modifier::REVERSED));
    }
    if let Some(whose) = whose {
        spans.push(Span::raw(format!(" {whose}")));
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

/// How the hub is, the longest words first.
fn over(scene: &Scene) -> Vec<Line<'static>> {
    let percent = scene.hub_percent.map(|percent| format!(" {percent:.1} %")).unwrap_or_default();
    let words = match (scene.hub_lives, scene.hub_pid) {
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

/// The sensors that have a line in `rows`: all, or those from the chosen one on.
fn listed<'a>(scene: &'a Scene, view: &View, rows: u16) -> impl Iterator<Item = (usize, &'a Sensor)> {
    let hidden = scene.sensors.len().saturating_sub(usize::from(rows));
    let first = view.only.unwrap_or(0).min(hidden);
    scene.sensors.iter().enumerate().skip(first)
}

/// A sensor in a line, the most needed first: what has no room on a narrow screen is left out whole.
fn line(number: usize, sensor: &Sensor, view: &View, width: u16) -> Line<'static> {
    let dash = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
    let hz = dash(sensor.meter.hz().map(|hz| format!("{hz:.1}")));
    let age = dash(sensor.meter.age_ms().map(|(mean, _)| format!("{mean:.2}")));
    let greatest = dash(sensor.meter.age_ms().map(|(_, greatest)| format!("{greatest:.2}")));
    let mut text = format!("{} {:<8} {:<9}", number + 1, sensor.name, sensor.state());
    let loss = sensor.status.and_then(|status| status.line_loss());
    let error = sensor.status.map(|status| status.last_error().to_owned()).unwrap_or_default();
    if sensor.scan.is_none() && !error.is_empty() {
        text += &format!(" {error}");
    } else {
        let mut fields = vec![format!(" {hz:>5} Hz")];
        fields.extend(loss.iter().map(|loss| format!("  {loss}")));
        fields.extend([format!(" {age:>5} ms"), format!("  lost {}", sensor.lost)]);
        if sensor.is_frozen() {
            fields.push("  frozen".to_owned());
        }
        fields.push(format!("  suspect {}", sensor.count(Counter::Suspect)));
        if width >= WIDE {
            let taught = sensor.background.as_ref().map_or(0, |model| model.taught);
            let marks = sensor.marks.map(|marks| marks.marks().len().to_string());
            let objects =
                sensor.foreground.as_ref().map(|foreground| foreground.segments().len().to_string());
            fields.extend([format!("  max {greatest} ms"), format!("  marks {}", dash(marks))]);
            fields.extend([format!("  objects {}", dash(objects)), format!("  background {taught}")]);
        }
        for field in fields {
            if text.chars().count() + field.chars().count() > usize::from(width) {
                break;
            }
            text += &field;
        }
    }
    let is_shown = view.only.is_none_or(|only| only == number);
    let mut style = if is_shown { Style::new() } else { Style::new().add_modifier(Modifier::DIM) };
    if loss.is_some() {
        style = style.add_modifier(Modifier::BOLD);
    }
    Line::styled(text, style)
}

/// A length of the picture that is easily compared: `|----| 1 m`.
fn measure(dot_m: f64) -> String {
    let cell_m = dot_m * DOTS.0;
    let length = LENGTHS_M.into_iter().rev().find(|length| length / cell_m <= MEASURE_CELLS);
    let length = length.unwrap_or(LENGTHS_M[0]);
    let cells = (length / cell_m).round().clamp(2.0, 4.0 * MEASURE_CELLS) as usize;
    format!("|{}| {length} m", "-".repeat(cells - 2))
}

/// What is under the pointer, if there is one, in at most `room` columns; what has no room is left out whole.
fn words(scene: &Scene, view: &View, room: usize) -> String {
    let Some(at) = view.pointer_m else { return String::new() };
    let shown = view.shown(scene);
    let place = PointerPosition::of(shown.iter().map(|(_, sensor)| *sensor), at, NEAR_DOTS * view.dot_m);
    let mut words = String::new();
    for part in place.words() {
        let between = if words.is_empty() { "" } else { ", " };
        if words.chars().count() + between.len() + part.chars().count() > room {
            break;
        }
        words += between;
        words += &part;
    }
    words
}

fn help(frame: &mut Frame<'_>, area: Rect) {
    let lines: Vec<Line<'_>> = HELP.lines().map(Line::raw).collect();
    let width = lines.iter().map(Line::width).max().unwrap_or_default() as u16 + 2;
    let (width, height) = (width.min(area.width), (lines.len() as u16 + 2).min(area.height));
    let (x, y) = (area.x + (area.width - width) / 2, area.y + (area.height - height) / 2);
    let place = Rect { x, y, width, height };
    frame.render_widget(Clear, place);
    frame.render_widget(Paragraph::new(lines).block(Block::bordered().title(" scanhub watch ")), place);
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

/// What keys do, and what signs mean; narrow enough for 60 columns, low enough for 16 rows.
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
o ,   foreground, its trail (coloured: without the signs)
* @   reflector mark, corner   ^ 1 2 robot, sensors
0.60! circle around the robot, in m, with something inside";

/// A point so near to the pointer is read.
const NEAR_DOTS: f64 = 6.0;
/// Columns from which a sensor's line says more.
const WIDE: u16 = 100;
const LENGTHS_M: [f64; 9] = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0];
/// The longest measure.
const MEASURE_CELLS: f64 = 12.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measures_are_round_and_short() {
        assert_eq!(measure(0.05), "|--------| 1 m");
        assert_eq!(measure(0.001), "|".to_owned() + &"-".repeat(48).as_str()[..46] + "| 0.1 m");
        assert_eq!(measure(1.0), "|--------| 20 m");
    }
}
