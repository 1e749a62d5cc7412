//! Tests of complete screens of a simulated scene. They are compared cell by cell with the files in `tests/watch`, and
//! with the picture in the documents. To accept a change, `SCANHUB_GOLDEN=write cargo test -p scanhub-viewer
//! watch::tests` writes the files again.

use std::f64::consts::PI;
use std::path::Path;

use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::style::{Color, Modifier};
use scanhub_schema::{
    ArrayFlags, Background, BackgroundHead, Corner, Counter, Foreground, ForegroundHead, Header, Line, Lines,
    Mark, Marks, Pose, Scan, ScanHead, Segment, State, Status, Track, TrackState, Tracks, Verdict, Zone,
    Zones,
};

use super::draw::{draw, map_area};
use super::view::View;
use crate::scene::{Scene, Sensor};

/// Walls of the room, in meters ahead and to the left of the robot.
const WALLS: [f64; 4] = [4.2, -3.4, 3.0, -3.6];
/// Legs of people as x, y and radius in meters: two legs ahead of the robot, and one at its rear.
const LEGS: [(f64, f64, f64); 3] = [(1.9, 0.9, 0.12), (2.1, 0.6, 0.12), (-0.75, -0.25, 0.1)];

/// Returns the length of the beam from `pose` along `direction` to a leg or a wall.
fn beam_length(pose: &Pose, (dx, dy): (f64, f64), legs: &[(f64, f64, f64)]) -> f64 {
    let wall = |to: f64, from: f64, slope: f64| ((to - from) / slope > 0.0).then(|| (to - from) / slope);
    let walls = [
        wall(WALLS[0], pose.x_m, dx),
        wall(WALLS[1], pose.x_m, dx),
        wall(WALLS[2], pose.y_m, dy),
        wall(WALLS[3], pose.y_m, dy),
    ];
    let leg = |&(x, y, radius): &(f64, f64, f64)| {
        let (x, y) = (x - pose.x_m, y - pose.y_m);
        let (along, beside) = (x * dx + y * dy, x * dy - y * dx);
        (along > 0.0 && beside.abs() < radius).then(|| along - (radius * radius - beside * beside).sqrt())
    };
    walls.into_iter().chain(legs.iter().map(leg)).flatten().fold(f64::INFINITY, f64::min)
}

/// Fills in the samples of a sensor at `pose`.
fn fill_samples(sensor: &mut Sensor, pose: Pose) {
    let mut scan = Scan::of(ScanHead::lms(361, -90_000, 500, 1, 13), &[0; 361]);
    let ScanHead { first_angle, step, unit_um, .. } = **scan;
    let head = BackgroundHead {
        first_angle,
        step,
        unit_um,
        known_beams: 361,
        generation: 1,
        ..BackgroundHead::default()
    };
    let mut background = Background::of(head, &[0; 361]);
    let mut foreground = Foreground::of(361);
    let mut head = ForegroundHead { generation: 1, count: 361, unit_um, ..ForegroundHead::default() };
    let arrays = foreground.begin(head);
    for i in 0..361 {
        let direction = pose.direction(scan.angle(i));
        let (now, empty) = (beam_length(&pose, direction, &LEGS), beam_length(&pose, direction, &[]));
        let range = (1000.0 * now) as u16;
        scan.arrays().ranges[i] = range;
        background.ranges_mut()[i] = (1000.0 * empty) as u16;
        if now < empty - 0.05 {
            arrays.bits[i / 8] |= 1 << (i % 8);
            arrays.ranges[usize::from(head.beams)] = range;
            head.beams += 1;
        }
    }
    arrays.segments[0] = Segment { first: 1, last: 2, ..Segment::default() };
    **foreground = ForegroundHead { segments: 1, ..head };
    let mut marks = Marks { count: 1, ..Marks::default() };
    marks.mark_array[0] = Mark { angle_mdeg: -20_000, range_dmm: 32_000, ..Mark::default() };
    let mut status = Status { state: State::Streaming as u8, baud: 500_000, pose, ..Status::default() };
    status.counters[Counter::Suspect] = 3;
    for n in 0..76 {
        let stamp_first_ns = n * 26_640_000;
        let stamp_last_ns = stamp_first_ns + 17_000_000;
        let header =
            Header { stamp_first_ns, stamp_last_ns, period_us: 26_640, hub_pid: 4711, ..Header::default() };
        sensor.take_scan(&header, &scan, stamp_last_ns + 70_000 + n % 10 * 4_000);
    }
    (sensor.foreground, sensor.background) = (Some(foreground), Some(background));
    sensor.marks = Some(marks);
    sensor.take_status(&status);
}

fn zones(verdict: Verdict, nearest_mm: u32, violated: [u8; 2]) -> Zones {
    let mut zones =
        Zones { verdict: verdict as u8, count: 2, nearest_beam: 180, nearest_mm, ..Zones::unknown() };
    for (zone, (radius_mm, violated)) in
        zones.zone_array.iter_mut().zip([(1000, violated[0]), (600, violated[1])])
    {
        *zone = Zone { radius_mm, violated, ..Zone::default() };
    }
    zones
}

/// Returns a scene with two sensors, a person ahead, and a person at the rear who is near enough to slow the robot
/// down.
pub(super) fn scene() -> Scene {
    let mut scene =
        Scene { hub_is_running: true, hub_pid: 4711, hub_percent: Some(1.234), ..Scene::default() };
    let front = scene.sensor("front");
    fill_samples(front, Pose { x_m: 0.3, ..Pose::default() });
    front.zones = zones(Verdict::Clear, 1870, [0, 0]);
    let rear = scene.sensor("rear");
    fill_samples(rear, Pose { x_m: -0.3, yaw_rad: PI, ..Pose::default() });
    rear.zones = zones(Verdict::Slow, 691, [1, 0]);
    rear.missed = 2;
    scene
}

pub(super) fn screen(scene: &Scene, view: &View, size: (u16, u16)) -> Buffer {
    screen_held(scene, None, view, size)
}

fn screen_held(scene: &Scene, held: Option<&Scene>, view: &View, (columns, rows): (u16, u16)) -> Buffer {
    let mut terminal = Terminal::new(TestBackend::new(columns, rows)).unwrap();
    let mut view = view.clone();
    let drawn = terminal.draw(|frame| {
        view.map = map_area(frame.area(), scene);
        view.fit(held.unwrap_or(scene));
        draw(frame, scene, held, &view);
    });
    drawn.unwrap().buffer.clone()
}

pub(super) fn text(buffer: &Buffer) -> String {
    let width = usize::from(buffer.area.width);
    let rows = buffer.content.chunks(width);
    let row = |cells: &[ratatui::buffer::Cell]| cells.iter().map(|cell| cell.symbol()).collect::<String>();
    rows.map(|cells| row(cells).trim_end().to_owned() + "\n").collect()
}

/// Compares `text` with `file`, a path in this crate.
fn compare(file: &str, text: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    if std::env::var_os("SCANHUB_GOLDEN").is_some_and(|order| order == "write") {
        std::fs::write(&path, text).unwrap();
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    assert!(kept == text, "{file} is not what is drawn now:\n{text}");
}

#[test]
fn draws_robot_on_small_and_large_screens() {
    let (scene, colors, plain) = (scene(), View::new(true), View::new(false));
    compare("tests/watch/robot_60x20.txt", &text(&screen(&scene, &colors, (60, 20))));
    compare("tests/watch/robot_120x40.txt", &text(&screen(&scene, &colors, (120, 40))));
    compare("tests/watch/plain_60x20.txt", &text(&screen(&scene, &plain, (60, 20))));
    compare("tests/watch/plain_120x40.txt", &text(&screen(&scene, &plain, (120, 40))));
}

#[test]
fn draws_help_single_sensor_and_missing_hub() {
    let mut scene = scene();
    let help = View { help: true, ..View::new(false) };
    compare("tests/watch/help_60x20.txt", &text(&screen(&scene, &help, (60, 20))));
    let rear =
        View { only_sensor: Some(1), background: false, zones: false, paused: true, ..View::new(false) };
    compare("tests/watch/rear_60x20.txt", &text(&screen(&scene, &rear, (60, 20))));
    scene.on_hub_exit();
    let gone = View { dot_m: 0.12, ..View::new(false) };
    compare("tests/watch/gone_60x20.txt", &text(&screen(&scene, &gone, (60, 20))));
}

#[test]
fn frozen_picture_has_the_current_verdict() {
    let (held, mut now) = (scene(), scene());
    let view = View { paused: true, ..View::new(false) };
    let before = text(&screen(&held, &view, (60, 20)));
    let rows = |now: &Scene| {
        let rows = text(&screen_held(now, Some(&held), &view, (60, 20)));
        assert!(
            rows.lines().zip(before.lines()).take(17).skip(1).all(|(now, before)| now == before),
            "{rows}"
        );
        rows.lines().map(str::to_owned).collect::<Vec<_>>()
    };
    now.sensor("front").zones = zones(Verdict::Stop, 412, [1, 1]);
    now.sensor("front").scan = None;
    now.sensor("rear").missed = 7;
    let stop = rows(&now);
    assert!(stop[0].starts_with(" STOP  HELD  front, nearest 0.41 m"), "{stop:#?}");
    assert!(stop[18].contains("missed 7"), "{stop:#?}");
    now.on_hub_exit();
    let gone = rows(&now);
    assert!(
        gone[0].starts_with(" UNKNOWN  HELD  front") && gone[0].ends_with("no hub: waiting for it"),
        "{gone:#?}"
    );
}

/// The picture suits light and dark terminals: no cell is black or white, or has a background color. Without colors,
/// signs replace the colors.
#[test]
fn uses_the_colors_of_the_terminal() {
    let scene = scene();
    let colors = screen(&scene, &View::new(true), (120, 40));
    let plain = screen(&scene, &View::new(false), (120, 40));
    let used = |buffer: &Buffer| {
        let mut used: Vec<Color> = Vec::new();
        for cell in &buffer.content {
            assert_eq!(cell.bg, Color::Reset);
            if !used.contains(&cell.fg) {
                used.push(cell.fg);
            }
        }
        used
    };
    assert_eq!(used(&plain), [Color::Reset]);
    for color in used(&colors) {
        let may = [
            Color::Reset,
            Color::DarkGray,
            Color::Magenta,
            Color::LightMagenta,
            Color::Cyan,
            Color::Red,
            Color::Yellow,
            Color::Green,
        ];
        assert!(may.contains(&color), "{color}");
    }
    let (colors, plain) = (text(&colors), text(&plain));
    // Skip the line of keys, which has an o and dots too.
    let count =
        |text: &str, sign| text.lines().skip(1).take(35).flat_map(str::chars).filter(|c| *c == sign).count();
    assert!(count(&plain, 'o') > 3 && count(&colors, 'o') == 0);
    assert!(count(&plain, '*') == 2 && count(&colors, '*') == 2, "a mark of each sensor");
    assert!(plain.starts_with(" SLOW  rear, nearest 0.69 m") && plain.contains("1.00!"));
}

#[test]
fn truncates_no_number_on_a_narrow_screen() {
    let (scene, view) = (scene(), View::new(false));
    let of = |columns| text(&screen(&scene, &view, (columns, 20)));
    let whole = of(120);
    let heading = |columns| of(columns).lines().next().unwrap_or_default().trim_end().to_owned();
    assert_eq!(heading(40), " SLOW  rear, nearest 0.69 m     hub 4711");
    assert_eq!([heading(20), heading(19)], [" SLOW  rear hub 4711", " SLOW  rear"]);
    let words: Vec<&str> = whole.split_whitespace().collect();
    for columns in 20..120 {
        let narrow = of(columns);
        let lines: Vec<&str> = narrow.lines().collect();
        let numbers = [0, lines.len() - 3, lines.len() - 2].map(|row| lines[row]).join(" ");
        for word in numbers.split_whitespace().filter(|word| word.starts_with(|c: char| c.is_ascii_digit())) {
            assert!(words.contains(&word), "{columns} columns: {word} of {numbers}");
        }
    }
}

#[test]
fn draws_on_tiny_screens() {
    let scene = scene();
    for size in [(1, 1), (2, 3), (10, 2), (60, 4), (300, 5), (5, 60)] {
        for help in [false, true] {
            screen(&scene, &View { help, ..View::new(true) }, size);
            screen(&Scene::default(), &View { help, ..View::new(true) }, size);
        }
    }
}

#[test]
fn documentation_picture_is_up_to_date() {
    compare("../../docs/watch.svg", &svg(&screen(&scene(), &View::new(true), (80, 30))));
}

/// Returns a screen as SVG. Braille is drawn as dots, because their position depends on the font.
fn svg(buffer: &Buffer) -> String {
    let (width, height) = (buffer.area.width * CELL.0, buffer.area.height * CELL.1);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"monospace\" \
         font-size=\"13\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"#fdfdfd\"/>\n"
    );
    for (n, cell) in buffer.content.iter().enumerate() {
        let n = n as u16;
        let (x, y) = (n % buffer.area.width * CELL.0, n / buffer.area.width * CELL.1);
        let sign = cell.symbol().chars().next().unwrap_or(' ');
        let mut ink = ink(cell.fg);
        if cell.modifier.contains(Modifier::REVERSED) {
            svg += &format!(
                "<rect x=\"{x}\" y=\"{y}\" width=\"{}\" height=\"{}\" fill=\"{ink}\"/>\n",
                CELL.0, CELL.1
            );
            ink = "#fdfdfd";
        }
        if ('\u{2801}'..='\u{28ff}').contains(&sign) {
            let pattern = sign as u32 - 0x2800;
            for (bit, (column, row)) in
                BRAILLE.into_iter().enumerate().filter(|(bit, _)| pattern >> bit & 1 == 1)
            {
                debug_assert!(bit < 8);
                let (x, y) = (x + 2 + 4 * column, y + 2 + 4 * row);
                svg += &format!("<circle cx=\"{x}\" cy=\"{y}\" r=\"1.4\" fill=\"{ink}\"/>\n");
            }
        } else if sign != ' ' {
            let sign = match sign {
                '<' => "&lt;".to_owned(),
                '&' => "&amp;".to_owned(),
                other => other.to_string(),
            };
            let faint = if cell.modifier.contains(Modifier::DIM) { " opacity=\"0.6\"" } else { "" };
            svg += &format!("<text x=\"{x}\" y=\"{}\" fill=\"{ink}\"{faint}>{sign}</text>\n", y + 12);
        }
    }
    svg + "</svg>\n"
}

/// Returns the color in a typical light terminal.
fn ink(color: Color) -> &'static str {
    match color {
        Color::DarkGray => "#a0a0a0",
        Color::Magenta => "#d79ac6",
        Color::LightMagenta => "#b0208a",
        Color::Blue => "#3a5fc4",
        Color::LightBlue => "#6a58c8",
        Color::Cyan => "#0a8a9a",
        Color::Red => "#c81e1e",
        Color::Yellow => "#b07800",
        Color::Green => "#2e8b2e",
        _ => "#202020",
    }
}

/// Size of a cell in the SVG.
const CELL: (u16, u16) = (8, 16);
/// Column and row of each dot, in the order of the bits (Unicode 2800h to 28FFh).
const BRAILLE: [(u16, u16); 8] = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3)];

#[test]
fn shows_loss_on_the_line_on_small_screens() {
    let mut scene = scene();
    let mut status = scene.sensor("rear").status.unwrap();
    status.counters[Counter::DueOnLine] = 1000;
    status.counters[Counter::LostPpm] = 412_000;
    scene.sensor("rear").take_status(&status);
    for size in [(60, 20), (120, 40)] {
        let screen = text(&screen(&scene, &View::new(true), size));
        let line = screen.lines().find(|line| line.starts_with("2 rear")).unwrap();
        assert!(line.contains(" Hz  41 % lost on the line"), "{line}");
        assert!(!screen.lines().any(|line| line.starts_with("1 front") && line.contains("line")), "{screen}");
    }
}

#[test]
fn shows_people_with_their_ids_and_tails() {
    let (mut scene, view) = (scene(), View::new(true));
    let plain = screen(&scene, &view, (120, 40));
    let mut tracks = Tracks::default();
    let persons = [(12, TrackState::Confirmed), (13, TrackState::Tentative), (14, TrackState::Hidden)];
    for ((id, state), y_m) in persons.into_iter().zip([-2.0, -1.0, 1.0]) {
        tracks.push(Track { id, x_m: 2.0, y_m, state: state as u8, ..Track::default() });
    }
    tracks.track_array[0].set_room("hall");
    for n in 0..20 {
        tracks.track_array[0].x_m = 1.0 + 0.05 * n as f32;
        scene.take_tracks("house", &tracks, 1 + n * 200_000_000);
    }
    let shown = screen(&scene, &view, (120, 40));
    let words = text(&shown);
    assert!(words.contains("#12") && !words.contains("#13") && words.contains("(#14)"), "{words}");
    assert!(
        words.lines().next().is_some_and(|line| line.contains("2 people: hall 1, elsewhere 1")),
        "{words}"
    );
    let green = |buffer: &Buffer| buffer.content.iter().filter(|cell| cell.fg == Color::LightGreen).count();
    assert!(green(&plain) == 0 && green(&shown) > 5, "{} and {}", green(&plain), green(&shown));
}

#[test]
fn shows_counters_the_pointer_and_line_features() {
    let mut scene = scene();
    let counters = View { counters: true, ..View::new(false) };
    let page = text(&screen(&scene, &counters, (80, 40)));
    for row in [
        "damaged on the line, last 10 s          0.00 %",
        "suspect                                      3",
        "scanner_restarts                             0",
    ] {
        assert!(page.contains(row), "{row}:\n{page}");
    }
    assert!(page.lines().nth(1).unwrap().ends_with("         front          rear"), "{page}");

    // The text has the reading of the nearest point, or the position of the pointer if no point is near.
    let front = scene.sensor("front").points().find(|point| point.beam == 180).unwrap();
    let pointing = View { pointer_m: Some((front.x_m - 0.05, front.y_m)), ..View::new(false) };
    let read = text(&screen(&scene, &pointing, (120, 40)));
    assert!(read.contains("4.20 m from the robot, x 4.20  y 0.00 m, front: 0.00\u{b0}, 3.900 m"), "{read}");
    let narrow = text(&screen(&scene, &pointing, (60, 20)));
    assert!(narrow.contains("4.20 m from the robot") && !narrow.contains("front: 0.00"), "{narrow}");
    let nowhere = View { pointer_m: Some((1.0, -2.0)), ..View::new(false) };
    let read = text(&screen(&scene, &nowhere, (120, 40)));
    assert!(read.contains("2.24 m from the robot, x 1.00  y -2.00 m\n") && read.contains('X'), "{read}");

    let mut lines = Lines { count: 1, corners: 1, ..Lines::default() };
    lines.line_array[0] = Line { x1_m: 1.0, y1_m: -1.0, x2_m: 1.0, y2_m: -3.0, ..Line::default() };
    lines.corner_array[0] = Corner { x_m: 2.0, y_m: -2.0, ..Corner::default() };
    scene.sensor("front").lines = Some(Box::new(lines));
    let colored = |scene: &Scene, view: &View, color: Color| {
        screen(scene, view, (120, 40)).content.iter().filter(|cell| cell.fg == color).count()
    };
    let (with, without) = (View { lines: true, ..View::new(true) }, View::new(true));
    assert!(colored(&scene, &with, Color::LightBlue) > 10);
    assert_eq!(colored(&scene, &without, Color::LightBlue), 0);
    let crossings = |view: &View| text(&screen(&scene, view, (120, 40))).matches('+').count();
    let bare = View { grid: false, ..View::new(true) };
    // One + is part of the keys.
    assert!(
        crossings(&without) > 20 && crossings(&bare) == 1,
        "{} {}",
        crossings(&without),
        crossings(&bare)
    );
}

#[test]
fn colors_show_intensities_and_trails() {
    let mut scene = Scene { hub_is_running: true, ..Scene::default() };
    let sensor = scene.sensor("front");
    let head = ScanHead {
        intensity_bits: 8,
        contents: ArrayFlags::UPPER,
        ..ScanHead::lms(181, -90_000, 1000, 1, 13)
    };
    let mut scan = Scan::of(head, &[4000; 181]);
    for (n, value) in scan.arrays().upper.iter_mut().enumerate() {
        *value = n as u8;
    }
    let mut found = Foreground::of(181);
    found.begin(ForegroundHead { count: 181, ..ForegroundHead::default() }).bits[3] = 0xFF;
    let header = |seq| Header { seq, ..Header::default() };
    sensor.take_status(&Status::default());
    sensor.take_scan(&header(1), &scan, 0);
    sensor.take_foreground(&found);
    sensor.take_pair(&scan, &found, 0);
    let inks = |view: &View| {
        let screen = screen(&scene, view, (120, 40));
        [Color::Blue, Color::Cyan, Color::Green, Color::Yellow, Color::Magenta, Color::LightMagenta]
            .map(|ink| screen.content.iter().filter(|cell| cell.fg == ink).count() > 0)
    };
    assert_eq!(
        inks(&View::new(true)),
        [true, true, true, true, false, true],
        "the foreground is over its trail"
    );
    let plain = View { intensity: false, foreground: false, ..View::new(true) };
    assert_eq!(inks(&plain), [false; 6]);
}
