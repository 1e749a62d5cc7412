//! What a person asks the terminal's picture for: counters, a place, lines, and what colours and trails say.

use ratatui::style::Color;
use scanhub_schema::{
    Contents, Corner, Foreground, ForegroundHead, Header, Line, Lines, Scan, ScanHead, Status,
};

use super::golden::{scene, screen, text};
use super::view::View;
use crate::scene::Scene;

/// Counters, what is pointed at, lines, trails and intensities.
#[test]
fn what_a_person_asks_for_is_drawn() {
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

    // The nearest point to what is pointed at is read; without a point, the place.
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
    let coloured = |scene: &Scene, view: &View, colour: Color| {
        screen(scene, view, (120, 40)).content.iter().filter(|cell| cell.fg == colour).count()
    };
    let (with, without) = (View { lines: true, ..View::new(true) }, View::new(true));
    assert!(coloured(&scene, &with, Color::LightBlue) > 10);
    assert_eq!(coloured(&scene, &without, Color::LightBlue), 0);
    let crossings = |view: &View| text(&screen(&scene, view, (120, 40))).matches('+').count();
    let bare = View { grid: false, ..View::new(true) };
    // One of them is among the keys.
    assert!(
        crossings(&without) > 20 && crossings(&bare) == 1,
        "{} {}",
        crossings(&without),
        crossings(&bare)
    );
}

#[test]
fn what_comes_back_is_seen_by_its_colour_and_who_went_by_his_trail() {
    let mut scene = Scene { hub_lives: true, ..Scene::default() };
    let sensor = scene.sensor("front");
    let head =
        ScanHead { intensity_bits: 8, contents: Contents::UPPER, ..ScanHead::lms(181, -90_000, 1000, 1, 13) };
    let mut scan = Scan::of(head, &[4000; 181]);
    for (n, value) in scan.arrays().upper.iter_mut().enumerate() {
        *value = n as u8;
    }
    let mut found = Foreground::of(181);
    found.begin(ForegroundHead { count: 181, ..ForegroundHead::default() }).bits[3] = 0xFF;
    let header = |seq| Header { seq, ..Header::default() };
    sensor.take_status(&Status::default());
    sensor.take_scan(&header(1), &scan, 0);
    sensor.take_foreground(&header(1), &found, 0);
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
