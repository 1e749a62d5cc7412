//! The robot from above: what its sensors see, as Braille dots; ahead is up. Without colours, another sign replaces
//! each colour.

#[cfg(all(test, feature = "web"))]
mod same;

use ratatui::style::Color;
use ratatui::symbols::Marker;
use ratatui::text::Line;
use ratatui::widgets::canvas::{Canvas, Context, Points};

use scanhub_schema::Verdict;

use super::view::View;
use crate::scene::{Scene, circles};

/// Dots of a cell of the terminal.
pub(crate) const DOTS: (f64, f64) = (2.0, 4.0);

/// The picture of `scene` for `cells`, columns and rows.
pub(crate) fn map(scene: &Scene, view: &View, cells: (u16, u16)) -> Canvas<'static, impl Fn(&mut Context)> {
    // Ends of the axes are dots, not edges of them.
    let half = |cells: u16, dots: f64| view.dot_m * (f64::from(cells) * dots - 1.0).max(1.0) / 2.0;
    let (aside, ahead) = (half(cells.0, DOTS.0), half(cells.1, DOTS.1));
    let (up, right) = (view.centre_m.0, -view.centre_m.1);
    let (x, y) = ([right - aside, right + aside], [up - ahead, up + ahead]);
    let mut layers = Layers::new(scene, view);
    if view.grid {
        layers.rule(x, y, view.dot_m);
    }
    layers.snap(&Grid { x, y, cells, dot_m: view.dot_m });
    Canvas::default()
        .marker(Marker::Braille)
        .x_bounds(x)
        .y_bounds(y)
        .paint(move |context| layers.paint(context))
}

/// The colour of a verdict, in the palette that the terminal's user chose.
pub(crate) fn colour(verdict: Verdict) -> Color {
    match verdict {
        Verdict::Clear => Color::Green,
        Verdict::Slow => Color::Yellow,
        Verdict::Stop | Verdict::Unknown => Color::Red,
    }
}

/// Points as the canvas has them: to the right, and up.
type Dots = Vec<(f64, f64)>;

/// The ends of both axes, and what lies between them.
struct Grid {
    x: [f64; 2],
    y: [f64; 2],
    cells: (u16, u16),
    dot_m: f64,
}

impl Grid {
    /// The place at which a sign gets into the cell that has the dot of `point`: the canvas spreads signs and dots over its
    /// axes apart from each other.
    fn cell(&self, (x, y): (f64, f64)) -> (f64, f64) {
        let cell = |from_m: f64, dots: f64, cells: u16, length: f64| {
            let cell = ((from_m / self.dot_m).round() / dots).floor() + 0.25;
            (cell * length / f64::from(cells.saturating_sub(1).max(1))).min(length)
        };
        let across = cell(x - self.x[0], DOTS.0, self.cells.0, self.x[1] - self.x[0]);
        let down = cell(self.y[1] - y, DOTS.1, self.cells.1, self.y[1] - self.y[0]);
        (self.x[0] + across, self.y[1] - down)
    }

    fn has(&self, (x, y): (f64, f64)) -> bool {
        (self.x[0]..=self.x[1]).contains(&x) && (self.y[0]..=self.y[1]).contains(&y)
    }
}

struct Layers {
    colours: bool,
    robot: Option<(f64, f64)>,
    background: Dots,
    circles: Vec<Circle>,
    /// Where beams ended, by how much came back.
    walls: [Dots; SHADES.len()],
    trails: Dots,
    foreground: Dots,
    lines: Dots,
    corners: Dots,
    grid: Dots,
    axes: Dots,
    pointer: Option<(f64, f64)>,
    marks: Dots,
    /// Sensors by their numbers from 1.
    sensors: Vec<(f64, f64, String)>,
    /// Where people were, and where they are, by their numbers; in brackets who is not seen.
    tails: Dots,
    people: Vec<(f64, f64, String)>,
}

struct Circle {
    dots: Dots,
    /// Where it stands, and what it says.
    label: Option<(f64, f64, String)>,
    colour: Color,
}

impl Layers {
    fn new(scene: &Scene, view: &View) -> Layers {
        let shown = view.shown(scene);
        let around = if view.zones { circles(shown.iter().map(|(_, sensor)| *sensor)) } else { Vec::new() };
        let mut layers = Layers {
            colours: view.colours,
            robot: (!scene.is_in_map()).then_some((0.0, 0.0)),
            background: Vec::new(),
            circles: around.iter().map(|circle| dotted(circle, view.dot_m)).collect(),
            walls: Default::default(),
            trails: Vec::new(),
            foreground: Vec::new(),
            lines: Vec::new(),
            corners: Vec::new(),
            grid: Vec::new(),
            axes: Vec::new(),
            pointer: view.pointer_m.map(turned),
            marks: Vec::new(),
            sensors: Vec::new(),
            tails: Vec::new(),
            people: Vec::new(),
        };
        for person in scene.people() {
            if view.trails {
                layers.tails.extend(person.tail().map(turned));
            }
            let (x, y) = turned(person.position);
            let number = format!("#{}", person.id);
            layers.people.push((x, y, if person.is_seen() { number } else { format!("({number})") }));
        }
        for (number, sensor) in shown {
            for point in sensor.points() {
                let shade = point.intensity.filter(|_| view.intensity).map(|value| sensor.shade(value));
                let wall = shade.map_or(0, |shade| 1 + (shade * 3.999) as usize);
                let is_foreground = point.is_foreground && view.foreground;
                let dots = if is_foreground { &mut layers.foreground } else { &mut layers.walls[wall] };
                dots.push(turned((point.x_m, point.y_m)));
            }
            if view.trails && view.foreground {
                layers.trails.extend(sensor.trail.points().map(turned));
            }
            if view.background {
                layers.background.extend(sensor.background_points().into_iter().map(turned));
            }
            if view.marks {
                layers.marks.extend(sensor.mark_points().into_iter().map(turned));
            }
            if let Some(found) = sensor.lines().filter(|_| view.lines) {
                layers.lines.extend(found.lines().iter().flat_map(|line| dots_of(line, view.dot_m)));
                let corners = found.corners().iter().map(|corner| (corner.x_m.into(), corner.y_m.into()));
                layers.corners.extend(corners.map(turned));
            }
            if let Some(pose) = sensor.placement.pose() {
                let (x, y) = turned((pose.x_m, pose.y_m));
                layers.sensors.push((x, y, (number + 1).to_string()));
            }
        }
        layers
    }

    /// Draws crossings of a grid in metres and dotted axes, from `x` to `y`.
    fn rule(&mut self, x: [f64; 2], y: [f64; 2], dot_m: f64) {
        let step = grid_step_m(dot_m);
        let ticks = |[from, to]: [f64; 2], step: f64| {
            let (first, last) = ((from / step).ceil() as i32, (to / step).floor() as i32);
            (first..=last).map(move |n| f64::from(n) * step)
        };
        self.grid.extend(ticks(x, step).flat_map(|across| ticks(y, step).map(move |up| (across, up))));
        let dots = step / (step / (AXIS_DOTS * dot_m)).round();
        self.axes.extend(ticks(x, dots).map(|across| (across, 0.0)));
        self.axes.extend(ticks(y, dots).map(|up| (0.0, up)));
    }

    /// Moves signs to where the cells of `grid` are.
    fn snap(&mut self, grid: &Grid) {
        let snap = |dots: &mut Dots| {
            dots.retain(|dot| grid.has(*dot));
            dots.iter_mut().for_each(|dot| *dot = grid.cell(*dot));
        };
        [&mut self.marks, &mut self.corners, &mut self.grid].into_iter().for_each(snap);
        if !self.colours {
            let signs = [
                &mut self.background,
                &mut self.foreground,
                &mut self.trails,
                &mut self.tails,
                &mut self.axes,
            ];
            signs.into_iter().for_each(snap);
        }
        self.pointer = self.pointer.filter(|at| grid.has(*at)).map(|at| grid.cell(at));
        self.robot = self.robot.filter(|at| grid.has(*at)).map(|at| grid.cell(at));
        for labels in [&mut self.sensors, &mut self.people] {
            labels.retain(|(x, y, _)| grid.has((*x, *y)));
            labels.iter_mut().for_each(|(x, y, _)| (*x, *y) = grid.cell((*x, *y)));
        }
        let labels = self.circles.iter_mut().filter_map(|circle| circle.label.as_mut());
        for (x, y, _) in labels.filter(|(x, y, _)| grid.has((*x, *y))) {
            (*x, *y) = grid.cell((*x, *y));
        }
    }

    fn paint(&self, context: &mut Context) {
        let colour = |colour| if self.colours { colour } else { Color::Reset };
        let draw = |context: &mut Context, coords: &Dots, color| context.draw(&Points { coords, color });
        if !self.colours {
            context.marker(Marker::Custom(':'));
        }
        draw(context, &self.axes, colour(Color::DarkGray));
        context.marker(Marker::Custom('+'));
        draw(context, &self.grid, colour(Color::DarkGray));
        context.marker(if self.colours { Marker::Braille } else { Marker::Custom('.') });
        draw(context, &self.background, colour(Color::DarkGray));
        context.marker(Marker::Braille);
        for circle in &self.circles {
            draw(context, &circle.dots, colour(circle.colour));
        }
        for (walls, ink) in self.walls.iter().zip(SHADES) {
            draw(context, walls, colour(ink));
        }
        draw(context, &self.lines, colour(Color::LightBlue));
        if !self.colours {
            context.marker(Marker::Custom(','));
        }
        draw(context, &self.trails, colour(Color::Magenta));
        draw(context, &self.tails, colour(Color::LightGreen));
        if !self.colours {
            context.marker(Marker::Custom('o'));
        }
        draw(context, &self.foreground, colour(Color::LightMagenta));
        context.marker(Marker::Custom('@'));
        draw(context, &self.corners, colour(Color::LightBlue));
        context.marker(Marker::Custom('*'));
        draw(context, &self.marks, colour(Color::Cyan));
        // Labels take over the colour of what is below them, unless they have one.
        let mut print = |x, y, label: &str, ink| context.print(x, y, Line::styled(label.to_owned(), ink));
        if let Some((x, y)) = self.robot {
            print(x, y, "^", Color::Reset);
        }
        for circle in &self.circles {
            if let Some((x, y, label)) = &circle.label {
                print(*x, *y, label, colour(circle.colour));
            }
        }
        for (x, y, number) in &self.sensors {
            print(*x, *y, number, Color::Reset);
        }
        for (x, y, number) in &self.people {
            print(*x, *y, number, colour(Color::LightGreen));
        }
        if let Some((x, y)) = self.pointer {
            print(x, y, "X", Color::Reset);
        }
    }
}

/// To the right and up, of metres ahead and to the left.
fn turned((x, y): (f64, f64)) -> (f64, f64) {
    (-y, x)
}

/// `line` from end to end, dot by dot.
fn dots_of(line: &scanhub_schema::Line, dot_m: f64) -> Dots {
    let [x1, y1, x2, y2] = [line.x1_m, line.y1_m, line.x2_m, line.y2_m].map(f64::from);
    let steps = ((x2 - x1).hypot(y2 - y1) / dot_m).ceil().clamp(1.0, 2000.0);
    let at = |n: u32| (x1 + (x2 - x1) * f64::from(n) / steps, y1 + (y2 - y1) * f64::from(n) / steps);
    (0..=steps as u32).map(at).map(turned).collect()
}

/// `circle` as a dotted line, from the top on.
fn dotted(circle: &crate::scene::Circle, dot_m: f64) -> Circle {
    let radius = circle.radius_m;
    let points = (radius / dot_m * std::f64::consts::TAU / CIRCLE_DOTS).clamp(8.0, 360.0) as u32;
    let at = |n: u32| f64::from(n) * std::f64::consts::TAU / f64::from(points);
    let is_large = radius / dot_m > LABEL_DOTS;
    let sign = if circle.is_violated() { "!" } else { "" };
    Circle {
        dots: (0..points).map(at).map(|at| (radius * at.sin(), radius * at.cos())).collect(),
        label: is_large.then(|| (0.0, radius, format!("{radius:.2}{sign}"))),
        colour: colour(circle.verdict),
    }
}

/// Metres between two crossings of the grid: a round length that is long enough to be counted.
pub(super) fn grid_step_m(dot_m: f64) -> f64 {
    STEPS_M.into_iter().find(|step| *step >= GRID_DOTS * dot_m).unwrap_or(50.0)
}

/// Without an intensity, and from the darkest to the brightest: what the palette has from cold to warm.
const SHADES: [Color; 5] = [Color::Reset, Color::Blue, Color::Cyan, Color::Green, Color::Yellow];
const STEPS_M: [f64; 9] = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0];
/// The least between two crossings.
const GRID_DOTS: f64 = 18.0;
/// Dots between two of an axis.
const AXIS_DOTS: f64 = 4.0;
/// Dots between two of a circle.
const CIRCLE_DOTS: f64 = 3.0;
/// Circles of a smaller radius have no room for a label.
const LABEL_DOTS: f64 = 7.0;
