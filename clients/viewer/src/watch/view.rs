//! Which part of a scene is shown and at which scale, and how keys and the mouse change that. Of the terminal it knows only
//! those, and where the picture is.

use ratatui::layout::{Position, Rect};

use super::keys::Key;
use super::map::DOTS;
use crate::scene::{Scene, Sensor};

/// What is shown.
#[derive(Clone, Debug)]
pub(crate) struct View {
    /// One sensor by its number from 0, or the robot with all of its own.
    pub(crate) only: Option<usize>,
    /// Where the picture is on the screen, in cells.
    pub(crate) map: Rect,
    /// What is in the middle of it, in metres in the robot's frame.
    pub(crate) centre_m: (f64, f64),
    /// Metres between two dots.
    pub(crate) dot_m: f64,
    /// Place and size follow what is seen.
    pub(crate) fits: bool,
    pub(crate) foreground: bool,
    pub(crate) background: bool,
    pub(crate) marks: bool,
    pub(crate) zones: bool,
    pub(crate) trails: bool,
    pub(crate) grid: bool,
    /// Points have the colour of what came back.
    pub(crate) intensity: bool,
    /// Straight surfaces and corners, which the hub looks for only as long as somebody follows them.
    pub(crate) lines: bool,
    /// What is read out, in metres in the robot's frame; arrows move it.
    pub(crate) pointer_m: Option<(f64, f64)>,
    /// Counters instead of the picture.
    pub(crate) counters: bool,
    /// The picture stands still.
    pub(crate) paused: bool,
    pub(crate) help: bool,
    /// Colours may be used.
    pub(crate) colours: bool,
    /// What stands below the picture for as long as it does.
    pub(crate) note: String,
    /// What became of a request, in words; empty if there is nothing new.
    pub(crate) news: String,
}

/// What a key asks for beyond the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Wish {
    /// To end.
    Quit,
    /// To end, as by a signal.
    Interrupt,
    /// To learn the background again.
    Reset,
    /// To hold the background, or to let it be learned on.
    Freeze,
}

impl View {
    /// All layers of the whole robot.
    pub(crate) fn new(colours: bool) -> View {
        View {
            only: None,
            map: Rect::default(),
            centre_m: (0.0, 0.0),
            dot_m: FIRST_DOT_M,
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
            colours,
            note: String::new(),
            news: String::new(),
        }
    }

    /// The sensors that are shown, with their numbers from 0.
    pub(crate) fn shown<'a>(&self, scene: &'a Scene) -> Vec<(usize, &'a Sensor)> {
        match self.only.and_then(|n| Some((n, scene.sensors.get(n)?))) {
            Some(one) => vec![one],
            None => scene.robot().collect(),
        }
    }

    /// Takes a key, with `scene` on the screen; what is left to be done for it.
    pub(crate) fn key(&mut self, key: Key, scene: &Scene) -> Option<Wish> {
        match key {
            Key::Interrupt => return Some(Wish::Interrupt),
            Key::Escape if self.help => self.help = false,
            Key::Escape if self.pointer_m.is_some() => self.pointer_m = None,
            Key::Escape if self.counters => self.counters = false,
            Key::Sign('q') | Key::Escape => return Some(Wish::Quit),
            Key::Sign('R') => return Some(Wish::Reset),
            Key::Sign('F') => return Some(Wish::Freeze),
            Key::Sign('?') => self.help = !self.help,
            Key::Sign(' ') => self.paused = !self.paused,
            Key::Sign('+' | '=') => self.zoom(1.0 / ZOOM),
            Key::Sign('-') => self.zoom(ZOOM),
            Key::Sign('c') => self.fits = true,
            Key::Sign('x') => {
                self.pointer_m = if self.pointer_m.is_none() { Some(self.centre_m) } else { None }
            }
            Key::Left | Key::Right | Key::Up | Key::Down => self.go(key),
            Key::Point(..) | Key::WheelUp(..) | Key::WheelDown(..) if self.help || self.counters => {}
            Key::Point(column, row) => self.pointer_m = self.at_m(column, row).or(self.pointer_m),
            Key::WheelUp(column, row) => self.zoom_at(column, row, 1.0 / ZOOM),
            Key::WheelDown(column, row) => self.zoom_at(column, row, ZOOM),
            Key::Sign('h') => self.pan(0.0, 1.0),
            Key::Sign('l') => self.pan(0.0, -1.0),
            Key::Sign('k') => self.pan(1.0, 0.0),
            Key::Sign('j') => self.pan(-1.0, 0.0),
            Key::Tab => self.choose(self.only.map_or(0, |n| n + 1), scene),
            Key::Sign(digit @ '0'..='9') => {
                let number = digit as usize - '0' as usize;
                self.choose(number.checked_sub(1).unwrap_or(usize::MAX), scene);
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

    /// Brings what is seen into the picture, unless a person chose its place; keeps what is about right, because a
    /// picture that breathes cannot be read.
    pub(crate) fn fit(&mut self, scene: &Scene) {
        let dots = (f64::from(self.map.width.max(1)) * DOTS.0, f64::from(self.map.height.max(1)) * DOTS.1);
        let shown = self.shown(scene);
        let seen: Vec<_> = shown.iter().flat_map(|(_, sensor)| sensor.points()).collect();
        if !self.fits || seen.is_empty() {
            return;
        }
        let reach = shown.iter().flat_map(|(_, sensor)| sensor.zones.zones().iter());
        let reach = reach.map(|zone| f64::from(zone.radius_mm) / 1000.0).fold(LEAST_M, f64::max);
        let ahead = span(seen.iter().map(|point| point.x_m).collect(), reach);
        let aside = span(seen.iter().map(|point| point.y_m).collect(), reach);
        let needed = ((aside.1 - aside.0) / dots.0).max((ahead.1 - ahead.0) / dots.1) * MARGIN;
        let fits = |middle: f64, span: (f64, f64), dots: f64| {
            let half = self.dot_m * dots / 2.0;
            middle - half <= span.0 && span.1 <= middle + half
        };
        let is_in = fits(self.centre_m.0, ahead, dots.1) && fits(self.centre_m.1, aside, dots.0);
        if !is_in || needed < TOO_SMALL * self.dot_m {
            self.dot_m = needed;
            self.centre_m = ((ahead.0 + ahead.1) / 2.0, (aside.0 + aside.1) / 2.0);
        }
    }

    /// The place in the middle of a cell of the screen, in metres in the robot's frame; nothing beside the picture.
    fn at_m(&self, column: u16, row: u16) -> Option<(f64, f64)> {
        if !self.map.contains(Position { x: column, y: row }) {
            return None;
        }
        // In dots from the middle of the picture.
        let from_middle =
            |cell: u16, cells: u16, dots: f64| (f64::from(cell) + 0.5 - f64::from(cells) / 2.0) * dots;
        let right = from_middle(column - self.map.x, self.map.width, DOTS.0);
        let down = from_middle(row - self.map.y, self.map.height, DOTS.1);
        Some((self.centre_m.0 - down * self.dot_m, self.centre_m.1 - right * self.dot_m))
    }

    /// Changes the size of the picture, and what is in this cell of the screen stays there.
    fn zoom_at(&mut self, column: u16, row: u16, factor: f64) {
        let Some(before) = self.at_m(column, row) else { return };
        self.zoom(factor);
        let after = self.at_m(column, row).unwrap_or(before);
        self.centre_m = (self.centre_m.0 + before.0 - after.0, self.centre_m.1 + before.1 - after.1);
    }

    fn zoom(&mut self, factor: f64) {
        self.fits = false;
        self.dot_m = (self.dot_m * factor).clamp(FINEST_DOT_M, COARSEST_DOT_M);
    }

    /// An arrow moves what is read out by a cell, or else the picture.
    fn go(&mut self, arrow: Key) {
        let (ahead, left) = match arrow {
            Key::Up => (1.0, 0.0),
            Key::Down => (-1.0, 0.0),
            Key::Left => (0.0, 1.0),
            _ => (0.0, -1.0),
        };
        let dot_m = self.dot_m;
        match &mut self.pointer_m {
            Some((x, y)) => (*x, *y) = (*x + ahead * DOTS.1 * dot_m, *y + left * DOTS.0 * dot_m),
            None => self.pan(ahead, left),
        }
    }

    /// By steps ahead and to the left.
    fn pan(&mut self, ahead: f64, left: f64) {
        self.fits = false;
        let step = STEP_DOTS * self.dot_m;
        let moved = |at: f64, steps: f64| (at + steps * step).clamp(-FARTHEST_M, FARTHEST_M);
        self.centre_m = (moved(self.centre_m.0, ahead), moved(self.centre_m.1, left));
    }

    /// Sensor number `n` alone, or all where there is none.
    fn choose(&mut self, n: usize, scene: &Scene) {
        self.only = (n < scene.sensors.len()).then_some(n);
    }
}

/// From the least to the greatest of `values`, few outliers left out, and at least `reach` around the centre.
fn span(mut values: Vec<f64>, reach: f64) -> (f64, f64) {
    values.sort_by(f64::total_cmp);
    let out = values.len() / OUTLIERS;
    (values[out].min(-reach), values[values.len() - 1 - out].max(reach))
}

/// Of one step of zoom and pan.
const ZOOM: f64 = 1.25;
const STEP_DOTS: f64 = 8.0;
/// Before anything is seen: eight metres in a picture of eighty columns.
const FIRST_DOT_M: f64 = 0.05;
const FINEST_DOT_M: f64 = 0.001;
const COARSEST_DOT_M: f64 = 1.0;
/// Farther than a sensor sees (82 m) from where it may sit (100 m).
const FARTHEST_M: f64 = 200.0;
/// At least so much around the robot.
const LEAST_M: f64 = 0.5;
const MARGIN: f64 = 1.1;
/// A picture that would be enough at this share of its size is redrawn.
const TOO_SMALL: f64 = 0.6;
/// One of so many points, at either end, is not worth a smaller picture.
const OUTLIERS: usize = 50;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{Header, Scan, ScanHead, Status};

    fn press(view: &mut View, scene: &Scene, keys: &str) -> Option<Wish> {
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
    fn keys_choose_sensors_and_layers() {
        let (mut view, scene) = (View::new(false), two());
        assert_eq!(view.shown(&scene).len(), 2);
        for only in [Some(0), Some(1), None] {
            view.key(Key::Tab, &scene);
            assert_eq!(view.only, only);
        }
        press(&mut view, &scene, "2fbmz ?");
        assert_eq!((view.only, view.shown(&scene)[0].1.name.as_str()), (Some(1), "rear"));
        assert!(!(view.foreground || view.background || view.marks || view.zones));
        assert!(view.paused && view.help);
        press(&mut view, &scene, "tgien");
        assert!(!(view.trails || view.grid || view.intensity) && view.lines && view.counters);
        press(&mut view, &scene, "9");
        assert_eq!(view.only, None, "there is no ninth");
    }

    #[test]
    fn escape_closes_the_help_first() {
        let (mut view, scene) = (View::new(false), two());
        press(&mut view, &scene, "?");
        assert_eq!(view.key(Key::Escape, &scene), None);
        assert_eq!(view.key(Key::Escape, &scene), Some(Wish::Quit));
        assert_eq!(press(&mut view, &scene, "q"), Some(Wish::Quit));
        assert_eq!(press(&mut view, &scene, "R"), Some(Wish::Reset));
        assert_eq!(press(&mut view, &scene, "F"), Some(Wish::Freeze));
        assert_eq!(view.key(Key::Interrupt, &scene), Some(Wish::Interrupt));
        assert!(view.fits, "and c with it does not mean the picture");
    }

    #[test]
    fn arrows_move_what_is_read_out_while_there_is_such() {
        let (mut view, scene) = (View::new(false), two());
        view.key(Key::Up, &scene);
        let moved = view.centre_m;
        assert!(moved.0 > 0.0, "the picture");
        press(&mut view, &scene, "x");
        view.key(Key::Left, &scene);
        view.key(Key::Down, &scene);
        let (x, y) = view.pointer_m.unwrap();
        assert!(
            (moved.0 - x - 4.0 * view.dot_m).abs() < 1e-9 && (y - 2.0 * view.dot_m).abs() < 1e-9,
            "a cell"
        );
        assert_eq!(view.centre_m, moved);
        assert_eq!((view.key(Key::Escape, &scene), view.pointer_m), (None, None));
        assert_eq!(view.key(Key::Escape, &scene), Some(Wish::Quit));
    }

    #[test]
    fn the_mouse_reads_and_its_wheel_zooms_where_it_is() {
        let (mut view, scene) = (View::new(false), two());
        view.map = Rect::new(0, 1, 60, 16);
        (view.centre_m, view.dot_m) = ((2.0, 1.0), 0.1);
        // A cell has 2 dots across and 4 up.
        view.key(Key::Point(30, 9), &scene);
        let (x, y) = view.pointer_m.unwrap();
        assert!((x - 1.8).abs() < 1e-9 && (y - 0.9).abs() < 1e-9, "{x} {y}");
        view.key(Key::Point(3, 0), &scene);
        assert_eq!(view.pointer_m, Some((x, y)), "beside the picture");
        let there = view.at_m(50, 3).unwrap();
        view.key(Key::WheelUp(50, 3), &scene);
        let still = view.at_m(50, 3).unwrap();
        assert!((view.dot_m - 0.08).abs() < 1e-9 && !view.fits);
        assert!((there.0 - still.0).hypot(there.1 - still.1) < 1e-9, "{there:?} {still:?}");
        view.key(Key::WheelDown(50, 3), &scene);
        assert!((view.dot_m - 0.1).abs() < 1e-9 && (view.centre_m.0 - 2.0).abs() < 1e-9);
        press(&mut view, &scene, "?");
        view.key(Key::Point(10, 10), &scene);
        assert_eq!(view.pointer_m, Some((x, y)), "the help is over it");
    }

    #[test]
    fn the_picture_fits_until_a_person_chooses_and_again_when_asked() {
        let (mut view, scene) = (View::new(false), two());
        view.map = Rect::new(0, 1, 60, 17);
        view.fit(&scene);
        let fitted = view.clone();
        // Half a circle of four metres ahead, and half a metre behind.
        assert!((fitted.centre_m.0 - 1.75).abs() < 0.1 && fitted.centre_m.1.abs() < 0.01, "{fitted:?}");
        assert!((8.0..10.0).contains(&(fitted.dot_m * 120.0)), "{fitted:?}");
        press(&mut view, &scene, "+l");
        assert!(view.dot_m < fitted.dot_m && view.centre_m.1 < 0.0, "right is negative");
        let chosen = view.centre_m;
        view.fit(&scene);
        assert_eq!(view.centre_m, chosen);
        press(&mut view, &scene, "kkkkkkkkkkkkkkkkkkkk");
        press(&mut view, &scene, "c");
        view.fit(&scene);
        assert_eq!((view.centre_m, view.dot_m), (fitted.centre_m, fitted.dot_m));
    }
}
