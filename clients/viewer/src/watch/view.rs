//! View of a scene: the visible part, the scale and the layers. Keys and the mouse change them.

use ratatui::layout::{Position, Rect};

use super::map::DOTS_PER_CELL;
use super::terminal::Key;
use crate::scene::{Scene, Sensor};

/// Part of the scene that is shown, with scale and layers.
#[derive(Clone, Debug)]
pub(crate) struct View {
    /// Index of the only sensor that is shown; `None` for all sensors of the robot.
    pub(crate) only_sensor: Option<usize>,
    /// Area of the picture on the screen, in cells.
    pub(crate) map: Rect,
    /// Center of the picture, in meters in the robot's frame.
    pub(crate) center_m: (f64, f64),
    /// Meters between two dots.
    pub(crate) dot_m: f64,
    /// Whether center and scale follow the points.
    pub(crate) fits: bool,
    pub(crate) foreground: bool,
    pub(crate) background: bool,
    pub(crate) marks: bool,
    pub(crate) zones: bool,
    pub(crate) trails: bool,
    pub(crate) grid: bool,
    /// Whether the color of a point shows its intensity.
    pub(crate) intensity: bool,
    /// Whether line features and corners are shown. The hub computes them only while they have a subscriber.
    pub(crate) lines: bool,
    /// Position of the pointer, in meters in the robot's frame. The arrow keys move the pointer.
    pub(crate) pointer_m: Option<(f64, f64)>,
    /// Whether counters are shown instead of the picture.
    pub(crate) counters: bool,
    /// Whether the picture is frozen.
    pub(crate) paused: bool,
    pub(crate) help: bool,
    /// Whether colors may be used.
    pub(crate) colors: bool,
    /// Text next to the keys.
    pub(crate) note: String,
    /// Message that is shown instead of the keys; empty if there is no message.
    pub(crate) message: String,
}

/// Command that the caller must execute for a key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ViewCommand {
    /// End the program.
    Quit,
    /// End the program as if by a signal.
    Interrupt,
    /// Reset the background.
    Reset,
    /// Freeze or thaw the background.
    Freeze,
}

impl View {
    /// Creates a view of the whole robot with all layers except line features.
    pub(crate) fn new(colors: bool) -> View {
        View {
            only_sensor: None,
            map: Rect::default(),
            center_m: (0.0, 0.0),
            dot_m: INITIAL_DOT_M,
            fits: true,
            foreground: true,
            background: true,
            marks: true,
            zones: true,
            trails: true,
            grid: true,
            intensity: true,
            lines: false,
            pointer_m: None,
            counters: false,
            paused: false,
            help: false,
            colors,
            note: String::new(),
            message: String::new(),
        }
    }

    /// Returns the sensors that are shown, with their indices.
    pub(crate) fn shown<'a>(&self, scene: &'a Scene) -> Vec<(usize, &'a Sensor)> {
        match self.only_sensor.and_then(|n| Some((n, scene.sensors.get(n)?))) {
            Some(one) => vec![one],
            None => scene.robot().collect(),
        }
    }

    /// Handles a key while `scene` is on the screen. Returns a command if the key has an effect outside the view.
    pub(crate) fn key(&mut self, key: Key, scene: &Scene) -> Option<ViewCommand> {
        match key {
            Key::Interrupt => return Some(ViewCommand::Interrupt),
            Key::Escape if self.help => self.help = false,
            Key::Escape if self.pointer_m.is_some() => self.pointer_m = None,
            Key::Escape if self.counters => self.counters = false,
            Key::Sign('q') | Key::Escape => return Some(ViewCommand::Quit),
            Key::Sign('R') => return Some(ViewCommand::Reset),
            Key::Sign('F') => return Some(ViewCommand::Freeze),
            Key::Sign('?') => self.help = !self.help,
            Key::Sign(' ') => self.paused = !self.paused,
            Key::Sign('+' | '=') => self.zoom(1.0 / ZOOM_FACTOR),
            Key::Sign('-') => self.zoom(ZOOM_FACTOR),
            Key::Sign('c') => self.fits = true,
            Key::Sign('x') => {
                self.pointer_m = if self.pointer_m.is_none() { Some(self.center_m) } else { None }
            }
            Key::Left | Key::Right | Key::Up | Key::Down => self.move_by(key),
            Key::Point(..) | Key::WheelUp(..) | Key::WheelDown(..) if self.help || self.counters => {}
            Key::Point(column, row) => self.pointer_m = self.at_m(column, row).or(self.pointer_m),
            Key::WheelUp(column, row) => self.zoom_at(column, row, 1.0 / ZOOM_FACTOR),
            Key::WheelDown(column, row) => self.zoom_at(column, row, ZOOM_FACTOR),
            Key::Sign('h') => self.pan(0.0, 1.0),
            Key::Sign('l') => self.pan(0.0, -1.0),
            Key::Sign('k') => self.pan(1.0, 0.0),
            Key::Sign('j') => self.pan(-1.0, 0.0),
            Key::Tab => self.select_sensor(self.only_sensor.map_or(0, |n| n + 1), scene),
            Key::Sign(digit @ '0'..='9') => {
                let number = digit as usize - '0' as usize;
                self.select_sensor(number.checked_sub(1).unwrap_or(usize::MAX), scene);
            }
            Key::Sign('f') => self.foreground = !self.foreground,
            Key::Sign('b') => self.background = !self.background,
            Key::Sign('m') => self.marks = !self.marks,
            Key::Sign('z') => self.zones = !self.zones,
            Key::Sign('t') => self.trails = !self.trails,
            Key::Sign('g') => self.grid = !self.grid,
            Key::Sign('i') => self.intensity = !self.intensity,
            Key::Sign('e') => self.lines = !self.lines,
            Key::Sign('n') => self.counters = !self.counters,
            _ => {}
        }
        None
    }

    /// Fits the points into the picture, unless the user has moved the picture. If the points fit already and the scale
    /// is about right, nothing changes, because a picture whose scale changes often is hard to read.
    pub(crate) fn fit(&mut self, scene: &Scene) {
        let dots = (
            f64::from(self.map.width.max(1)) * DOTS_PER_CELL.0,
            f64::from(self.map.height.max(1)) * DOTS_PER_CELL.1,
        );
        let shown = self.shown(scene);
        let points: Vec<_> = shown.iter().flat_map(|(_, sensor)| sensor.points()).collect();
        if !self.fits || points.is_empty() {
            return;
        }
        let reach = shown.iter().flat_map(|(_, sensor)| sensor.zones.zones().iter());
        let reach = reach.map(|zone| f64::from(zone.radius_mm) / 1000.0).fold(MIN_REACH_M, f64::max);
        let ahead = span(points.iter().map(|point| point.x_m).collect(), reach);
        let lateral = span(points.iter().map(|point| point.y_m).collect(), reach);
        let needed = ((lateral.1 - lateral.0) / dots.0).max((ahead.1 - ahead.0) / dots.1) * MARGIN_FACTOR;
        let fits = |middle: f64, span: (f64, f64), dots: f64| {
            let half = self.dot_m * dots / 2.0;
            middle - half <= span.0 && span.1 <= middle + half
        };
        let is_in = fits(self.center_m.0, ahead, dots.1) && fits(self.center_m.1, lateral, dots.0);
        if !is_in || needed < MIN_FILL_SHARE * self.dot_m {
            self.dot_m = needed;
            self.center_m = ((ahead.0 + ahead.1) / 2.0, (lateral.0 + lateral.1) / 2.0);
        }
    }

    /// Returns the position of the middle of a cell, in meters in the robot's frame; `None` outside the picture.
    fn at_m(&self, column: u16, row: u16) -> Option<(f64, f64)> {
        if !self.map.contains(Position { x: column, y: row }) {
            return None;
        }
        // The distance from the middle of the picture is in dots.
        let from_middle =
            |cell: u16, cells: u16, dots: f64| (f64::from(cell) + 0.5 - f64::from(cells) / 2.0) * dots;
        let right = from_middle(column - self.map.x, self.map.width, DOTS_PER_CELL.0);
        let down = from_middle(row - self.map.y, self.map.height, DOTS_PER_CELL.1);
        Some((self.center_m.0 - down * self.dot_m, self.center_m.1 - right * self.dot_m))
    }

    /// Changes the scale, so that the position under this cell of the screen stays there.
    fn zoom_at(&mut self, column: u16, row: u16, factor: f64) {
        let Some(before) = self.at_m(column, row) else { return };
        self.zoom(factor);
        let after = self.at_m(column, row).unwrap_or(before);
        self.center_m = (self.center_m.0 + before.0 - after.0, self.center_m.1 + before.1 - after.1);
    }

    fn zoom(&mut self, factor: f64) {
        self.fits = false;
        self.dot_m = (self.dot_m * factor).clamp(MIN_DOT_M, MAX_DOT_M);
    }

    /// Moves the pointer by a cell, or the picture if there is no pointer.
    fn move_by(&mut self, arrow: Key) {
        let (ahead, left) = match arrow {
            Key::Up => (1.0, 0.0),
            Key::Down => (-1.0, 0.0),
            Key::Left => (0.0, 1.0),
            _ => (0.0, -1.0),
        };
        let dot_m = self.dot_m;
        match &mut self.pointer_m {
            Some((x, y)) => {
                (*x, *y) = (*x + ahead * DOTS_PER_CELL.1 * dot_m, *y + left * DOTS_PER_CELL.0 * dot_m)
            }
            None => self.pan(ahead, left),
        }
    }

    /// Moves the picture by steps ahead and to the left.
    fn pan(&mut self, ahead: f64, left: f64) {
        self.fits = false;
        let step = STEP_DOTS * self.dot_m;
        let moved = |at: f64, steps: f64| (at + steps * step).clamp(-MAX_CENTER_M, MAX_CENTER_M);
        self.center_m = (moved(self.center_m.0, ahead), moved(self.center_m.1, left));
    }

    /// Shows only the sensor with index `n`, or all sensors if there is no sensor with this index.
    fn select_sensor(&mut self, n: usize, scene: &Scene) {
        self.only_sensor = (n < scene.sensors.len()).then_some(n);
    }
}

/// Returns minimum and maximum of `values` without a few outliers, and at least `reach` around the center.
fn span(mut values: Vec<f64>, reach: f64) -> (f64, f64) {
    values.sort_by(f64::total_cmp);
    let out = values.len() / OUTLIER_DIVISOR;
    (values[out].min(-reach), values[values.len() - 1 - out].max(reach))
}

/// Factor by which one zoom step changes the scale.
const ZOOM_FACTOR: f64 = 1.25;
/// Distance by which one pan step moves the picture, in dots.
const STEP_DOTS: f64 = 8.0;
/// Scale before the first scan: eight meters in a picture of 80 columns.
const INITIAL_DOT_M: f64 = 0.05;
const MIN_DOT_M: f64 = 0.001;
const MAX_DOT_M: f64 = 1.0;
/// Maximum of the center's x and y, relative to the robot, to which the user can pan the picture. It exceeds the range of
/// a sensor (82 m) plus the sensor's maximum distance from the robot (100 m).
const MAX_CENTER_M: f64 = 200.0;
/// Minimum distance around the robot that the picture shows while it is fitted to the points, in meters.
const MIN_REACH_M: f64 = 0.5;
/// Size of the picture relative to the area of the points.
const MARGIN_FACTOR: f64 = 1.1;
/// Minimum share of the picture that the points must fill. If they fill less, the scale changes.
const MIN_FILL_SHARE: f64 = 0.6;
/// Number of points for each outlier that is ignored at either end of an axis.
const OUTLIER_DIVISOR: usize = 50;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{Header, Scan, ScanHead, Status};

    fn press(view: &mut View, scene: &Scene, keys: &str) -> Option<ViewCommand> {
        keys.chars().map(|key| view.key(Key::Sign(key), scene)).last().flatten()
    }

    fn two() -> Scene {
        let mut scene = Scene::default();
        for name in ["front", "rear"] {
            let scan = Scan::of(ScanHead::lms(181, -90_000, 1000, 1, 13), &[4000; 181]);
            let sensor = scene.sensor(name);
            sensor.take_status(&Status::default());
            sensor.take_scan(&Header::default(), &scan, 0);
        }
        scene
    }

    #[test]
    fn keys_select_sensors_and_layers() {
        let (mut view, scene) = (View::new(false), two());
        assert_eq!(view.shown(&scene).len(), 2);
        for only in [Some(0), Some(1), None] {
            view.key(Key::Tab, &scene);
            assert_eq!(view.only_sensor, only);
        }
        press(&mut view, &scene, "2fbmz ?");
        assert_eq!((view.only_sensor, view.shown(&scene)[0].1.name.as_str()), (Some(1), "rear"));
        assert!(!(view.foreground || view.background || view.marks || view.zones));
        assert!(view.paused && view.help);
        press(&mut view, &scene, "tgien");
        assert!(!(view.trails || view.grid || view.intensity) && view.lines && view.counters);
        press(&mut view, &scene, "9");
        assert_eq!(view.only_sensor, None, "there is no ninth");
    }

    #[test]
    fn escape_closes_the_help_first() {
        let (mut view, scene) = (View::new(false), two());
        press(&mut view, &scene, "?");
        assert_eq!(view.key(Key::Escape, &scene), None);
        assert_eq!(view.key(Key::Escape, &scene), Some(ViewCommand::Quit));
        assert_eq!(press(&mut view, &scene, "q"), Some(ViewCommand::Quit));
        assert_eq!(press(&mut view, &scene, "R"), Some(ViewCommand::Reset));
        assert_eq!(press(&mut view, &scene, "F"), Some(ViewCommand::Freeze));
        assert_eq!(view.key(Key::Interrupt, &scene), Some(ViewCommand::Interrupt));
        assert!(view.fits, "and c with it does not mean the picture");
    }

    #[test]
    fn arrows_move_the_pointer_or_else_the_picture() {
        let (mut view, scene) = (View::new(false), two());
        view.key(Key::Up, &scene);
        let moved = view.center_m;
        assert!(moved.0 > 0.0, "the picture");
        press(&mut view, &scene, "x");
        view.key(Key::Left, &scene);
        view.key(Key::Down, &scene);
        let (x, y) = view.pointer_m.unwrap();
        assert!(
            (moved.0 - x - 4.0 * view.dot_m).abs() < 1e-9 && (y - 2.0 * view.dot_m).abs() < 1e-9,
            "a cell"
        );
        assert_eq!(view.center_m, moved);
        assert_eq!((view.key(Key::Escape, &scene), view.pointer_m), (None, None));
        assert_eq!(view.key(Key::Escape, &scene), Some(ViewCommand::Quit));
    }

    #[test]
    fn mouse_moves_the_pointer_and_wheel_zooms() {
        let (mut view, scene) = (View::new(false), two());
        view.map = Rect::new(0, 1, 60, 16);
        (view.center_m, view.dot_m) = ((2.0, 1.0), 0.1);
        // A cell has 2 dots across and 4 up.
        view.key(Key::Point(30, 9), &scene);
        let (x, y) = view.pointer_m.unwrap();
        assert!((x - 1.8).abs() < 1e-9 && (y - 0.9).abs() < 1e-9, "{x} {y}");
        view.key(Key::Point(3, 0), &scene);
        assert_eq!(view.pointer_m, Some((x, y)), "outside the picture");
        let there = view.at_m(50, 3).unwrap();
        view.key(Key::WheelUp(50, 3), &scene);
        let still = view.at_m(50, 3).unwrap();
        assert!((view.dot_m - 0.08).abs() < 1e-9 && !view.fits);
        assert!((there.0 - still.0).hypot(there.1 - still.1) < 1e-9, "{there:?} {still:?}");
        view.key(Key::WheelDown(50, 3), &scene);
        assert!((view.dot_m - 0.1).abs() < 1e-9 && (view.center_m.0 - 2.0).abs() < 1e-9);
        press(&mut view, &scene, "?");
        view.key(Key::Point(10, 10), &scene);
        assert_eq!(view.pointer_m, Some((x, y)), "the help is over it");
    }

    #[test]
    fn picture_fits_until_moved_and_after_key_c() {
        let (mut view, scene) = (View::new(false), two());
        view.map = Rect::new(0, 1, 60, 17);
        view.fit(&scene);
        let fitted = view.clone();
        // The points are half a circle with a radius of four meters ahead, and half a meter at the rear is added.
        assert!((fitted.center_m.0 - 1.75).abs() < 0.1 && fitted.center_m.1.abs() < 0.01, "{fitted:?}");
        assert!((8.0..10.0).contains(&(fitted.dot_m * 120.0)), "{fitted:?}");
        press(&mut view, &scene, "+l");
        assert!(view.dot_m < fitted.dot_m && view.center_m.1 < 0.0, "right is negative");
        let chosen = view.center_m;
        view.fit(&scene);
        assert_eq!(view.center_m, chosen);
        press(&mut view, &scene, "kkkkkkkkkkkkkkkkkkkk");
        press(&mut view, &scene, "c");
        view.fit(&scene);
        assert_eq!((view.center_m, view.dot_m), (fitted.center_m, fitted.dot_m));
    }
}
