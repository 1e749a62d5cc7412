//! Map of the robot from above: points and figures of the sensors as Braille dots. Ahead is up. Without colors, a sign
//! replaces each color.

use ratatui::style::Color;
use ratatui::symbols::Marker;
use ratatui::text::Line;
use ratatui::widgets::canvas::{Canvas, Context, Points};

use scanhub_schema::Verdict;

use super::view::View;
use crate::scene::{Scene, circles};

/// Dots across and down in a cell of the terminal.
pub(super) const DOTS_PER_CELL: (f64, f64) = (2.0, 4.0);

/// Returns the picture of `scene`. `cells` is the number of columns and rows.
pub(super) fn map(scene: &Scene, view: &View, cells: (u16, u16)) -> Canvas<'static, impl Fn(&mut Context)> {
    // The ends of the axes are the centers of dots, not their edges.
    let half = |cells: u16, dots: f64| view.dot_m * (f64::from(cells) * dots - 1.0).max(1.0) / 2.0;
    let (lateral, ahead) = (half(cells.0, DOTS_PER_CELL.0), half(cells.1, DOTS_PER_CELL.1));
    let (up, right) = (view.center_m.0, -view.center_m.1);
    let (x, y) = ([right - lateral, right + lateral], [up - ahead, up + ahead]);
    let mut layers = Layers::new(scene, view);
    if view.grid {
        layers.add_grid(x, y, view.dot_m);
    }
    layers.snap(&Grid { x, y, cells, dot_m: view.dot_m });
    Canvas::default()
        .marker(Marker::Braille)
        .x_bounds(x)
        .y_bounds(y)
        .paint(move |context| layers.paint(context))
}

/// Returns the color of a verdict, in the palette of the terminal.
pub(super) fn color(verdict: Verdict) -> Color {
    match verdict {
        Verdict::Clear => Color::Green,
        Verdict::Slow => Color::Yellow,
        Verdict::Stop | Verdict::Unknown => Color::Red,
    }
}

/// Points in the coordinates of the canvas: to the right, and up.
type Dots = Vec<(f64, f64)>;

/// Ends of both axes, and the number of cells between them.
struct Grid {
    x: [f64; 2],
    y: [f64; 2],
    cells: (u16, u16),
    dot_m: f64,
}

impl Grid {
    /// Returns the position at which a sign must be drawn to appear in the cell that has the point's dot. The canvas
    /// assigns signs and dots to cells in different ways.
    fn cell(&self, (x, y): (f64, f64)) -> (f64, f64) {
        let cell = |from_m: f64, dots: f64, cells: u16, length: f64| {
            let cell = ((from_m / self.dot_m).round() / dots).floor() + 0.25;
            (cell * length / f64::from(cells.saturating_sub(1).max(1))).min(length)
        };
        let across = cell(x - self.x[0], DOTS_PER_CELL.0, self.cells.0, self.x[1] - self.x[0]);
        let down = cell(self.y[1] - y, DOTS_PER_CELL.1, self.cells.1, self.y[1] - self.y[0]);
        (self.x[0] + across, self.y[1] - down)
    }

    fn has(&self, (x, y): (f64, f64)) -> bool {
        (self.x[0]..=self.x[1]).contains(&x) && (self.y[0]..=self.y[1]).contains(&y)
    }
}

/// Everything that is drawn, in coordinates of the canvas.
#[derive(Default)]
struct Layers {
    colors: bool,
    robot: Option<(f64, f64)>,
    background: Dots,
    circles: Vec<Circle>,
    /// Points without foreground, by intensity.
    walls: [Dots; SHADES.len()],
    trails: Dots,
    foreground: Dots,
    lines: Dots,
    corners: Dots,
    grid: Dots,
    axes: Dots,
    pointer: Option<(f64, f64)>,
    marks: Dots,
    /// Positions of sensors, and their numbers from 1 on.
    sensors: Vec<(f64, f64, String)>,
    /// Positions of people over the last seconds.
    tails: Dots,
    /// Positions of people, and their IDs; in parentheses if they are not seen.
    people: Vec<(f64, f64, String)>,
}

struct Circle {
    dots: Dots,
    /// Position and text of the label; `None` for a small circle.
    label: Option<(f64, f64, String)>,
    color: Color,
}

impl Layers {
    fn new(scene: &Scene, view: &View) -> Layers {
        let shown = view.shown(scene);
        let zone_circles =
            if view.zones { circles(shown.iter().map(|(_, sensor)| *sensor)) } else { Vec::new() };
        let mut layers = Layers {
            colors: view.colors,
            robot: (!scene.is_in_map()).then_some((0.0, 0.0)),
            circles: zone_circles.iter().map(|circle| dotted(circle, view.dot_m)).collect(),
            pointer: view.pointer_m.map(to_canvas),
            ..Layers::default()
        };
        for person in scene.people() {
            if view.trails {
                layers.tails.extend(person.tail().map(to_canvas));
            }
            let (x, y) = to_canvas(person.position);
            let number = format!("#{}", person.id);
            layers.people.push((x, y, if person.is_seen() { number } else { format!("({number})") }));
        }
        for (number, sensor) in shown {
            for point in sensor.points() {
                let shade = point.intensity.filter(|_| view.intensity).map(|value| sensor.shade(value));
                let wall = shade.map_or(0, |shade| 1 + (shade * 3.999) as usize);
                let is_foreground = point.is_foreground && view.foreground;
                let dots = if is_foreground { &mut layers.foreground } else { &mut layers.walls[wall] };
                dots.push(to_canvas((point.x_m, point.y_m)));
            }
            if view.trails && view.foreground {
                layers.trails.extend(sensor.trail.points().map(to_canvas));
            }
            if view.background {
                layers.background.extend(sensor.background_points().into_iter().map(to_canvas));
            }
            if view.marks {
                layers.marks.extend(sensor.mark_points().into_iter().map(to_canvas));
            }
            if let Some(found) = sensor.lines().filter(|_| view.lines) {
                layers.lines.extend(found.lines().iter().flat_map(|line| dots_of(line, view.dot_m)));
                let corners = found.corners().iter().map(|corner| (corner.x_m.into(), corner.y_m.into()));
                layers.corners.extend(corners.map(to_canvas));
            }
            if let Some(pose) = sensor.placement.pose() {
                let (x, y) = to_canvas((pose.x_m, pose.y_m));
                layers.sensors.push((x, y, (number + 1).to_string()));
            }
        }
        layers
    }

    /// Adds the crossings of a grid in meters, and dotted axes, in the bounds `x` and `y`.
    fn add_grid(&mut self, x: [f64; 2], y: [f64; 2], dot_m: f64) {
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

    /// Moves each sign to its cell in `grid`.
    fn snap(&mut self, grid: &Grid) {
        let snap = |dots: &mut Dots| {
            dots.retain(|dot| grid.has(*dot));
            dots.iter_mut().for_each(|dot| *dot = grid.cell(*dot));
        };
        [&mut self.marks, &mut self.corners, &mut self.grid].into_iter().for_each(snap);
        if !self.colors {
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
        let ink = |color| if self.colors { color } else { Color::Reset };
        let draw = |context: &mut Context, coords: &Dots, color| context.draw(&Points { coords, color });
        if !self.colors {
            context.marker(Marker::Custom(':'));
        }
        draw(context, &self.axes, ink(Color::DarkGray));
        context.marker(Marker::Custom('+'));
        draw(context, &self.grid, ink(Color::DarkGray));
        context.marker(if self.colors { Marker::Braille } else { Marker::Custom('.') });
        draw(context, &self.background, ink(Color::DarkGray));
        context.marker(Marker::Braille);
        for circle in &self.circles {
            draw(context, &circle.dots, ink(circle.color));
        }
        for (walls, shade) in self.walls.iter().zip(SHADES) {
            draw(context, walls, ink(shade));
        }
        draw(context, &self.lines, ink(Color::LightBlue));
        if !self.colors {
            context.marker(Marker::Custom(','));
        }
        draw(context, &self.trails, ink(Color::Magenta));
        draw(context, &self.tails, ink(Color::LightGreen));
        if !self.colors {
            context.marker(Marker::Custom('o'));
        }
        draw(context, &self.foreground, ink(Color::LightMagenta));
        context.marker(Marker::Custom('@'));
        draw(context, &self.corners, ink(Color::LightBlue));
        context.marker(Marker::Custom('*'));
        draw(context, &self.marks, ink(Color::Cyan));
        // A label without a color has the color of the dots below it.
        let mut print = |x, y, label: &str, color| context.print(x, y, Line::styled(label.to_owned(), color));
        if let Some((x, y)) = self.robot {
            print(x, y, "^", Color::Reset);
        }
        for circle in &self.circles {
            if let Some((x, y, label)) = &circle.label {
                print(*x, *y, label, ink(circle.color));
            }
        }
        for (x, y, number) in &self.sensors {
            print(*x, *y, number, Color::Reset);
        }
        for (x, y, number) in &self.people {
            print(*x, *y, number, ink(Color::LightGreen));
        }
        if let Some((x, y)) = self.pointer {
            print(x, y, "X", Color::Reset);
        }
    }
}

/// Converts a position, in meters ahead and to the left, to the coordinates of the canvas: to the right, and up.
fn to_canvas((x, y): (f64, f64)) -> (f64, f64) {
    (-y, x)
}

/// Returns the dots of `line` from end to end.
fn dots_of(line: &scanhub_schema::Line, dot_m: f64) -> Dots {
    let [x1, y1, x2, y2] = [line.x1_m, line.y1_m, line.x2_m, line.y2_m].map(f64::from);
    let steps = ((x2 - x1).hypot(y2 - y1) / dot_m).ceil().clamp(1.0, 2000.0);
    let at = |n: u32| (x1 + (x2 - x1) * f64::from(n) / steps, y1 + (y2 - y1) * f64::from(n) / steps);
    (0..=steps as u32).map(at).map(to_canvas).collect()
}

/// Returns `circle` as a dotted line that starts at the top.
fn dotted(circle: &crate::scene::Circle, dot_m: f64) -> Circle {
    let radius = circle.radius_m;
    let points = (radius / dot_m * std::f64::consts::TAU / CIRCLE_DOTS).clamp(8.0, 360.0) as u32;
    let at = |n: u32| f64::from(n) * std::f64::consts::TAU / f64::from(points);
    let is_large = radius / dot_m > LABEL_DOTS;
    let sign = if circle.is_violated() { "!" } else { "" };
    Circle {
        dots: (0..points).map(at).map(|at| (radius * at.sin(), radius * at.cos())).collect(),
        label: is_large.then(|| (0.0, radius, format!("{radius:.2}{sign}"))),
        color: color(circle.verdict),
    }
}

/// Returns the distance between two crossings of the grid in meters: a round length of at least [`GRID_DOTS`] dots.
fn grid_step_m(dot_m: f64) -> f64 {
    STEPS_M.into_iter().find(|step| *step >= GRID_DOTS * dot_m).unwrap_or(50.0)
}

/// Colors of points. The first color is for points without an intensity. The others are for points with an intensity,
/// from the darkest to the brightest.
const SHADES: [Color; 5] = [Color::Reset, Color::Blue, Color::Cyan, Color::Green, Color::Yellow];
const STEPS_M: [f64; 9] = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0];
/// Minimum distance between two crossings of the grid, in dots.
const GRID_DOTS: f64 = 18.0;
/// Distance between two drawn points of an axis, in dots.
const AXIS_DOTS: f64 = 4.0;
/// Distance between two drawn points of a circle, in dots.
const CIRCLE_DOTS: f64 = 3.0;
/// Minimum radius of a circle with a label, in dots.
const LABEL_DOTS: f64 = 7.0;

#[cfg(all(test, feature = "web"))]
mod tests;
