//! The robot from above: what its sensors see, as Braille dots; ahead is up. Without colours, another sign replaces
//! each colour.

use ratatui::style::Color;
use ratatui::symbols::Marker;
use ratatui::text::Line;
use ratatui::widgets::canvas::{Canvas, Context, Points};

use schema::Verdict;

use super::view::View;
use scene::{Scene, circles};

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
    walls: Dots,
    foreground: Dots,
    marks: Dots,
    /// Sensors by their numbers from 1.
    sensors: Vec<(f64, f64, String)>,
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
            robot: Some((0.0, 0.0)),
            background: Vec::new(),
            circles: around.iter().map(|circle| dotted(circle, view.dot_m)).collect(),
            walls: Vec::new(),
            foreground: Vec::new(),
            marks: Vec::new(),
            sensors: Vec::new(),
        };
        for (number, sensor) in shown {
            for point in sensor.points() {
                let is_foreground = point.is_foreground && view.foreground;
                let dots = if is_foreground { &mut layers.foreground } else { &mut layers.walls };
                dots.push((-point.y_m, point.x_m));
            }
            let turned = |points: Dots| points.into_iter().map(|(x, y)| (-y, x));
            if view.background {
                layers.background.extend(turned(sensor.background_points()));
            }
            if view.marks {
                layers.marks.extend(turned(sensor.mark_points()));
            }
            let pose = sensor.pose;
            layers.sensors.push((-pose.y_m, pose.x_m, (number + 1).to_string()));
        }
        layers
    }

    /// Moves signs to where the cells of `grid` are.
    fn snap(&mut self, grid: &Grid) {
        let snap = |dots: &mut Dots| {
            dots.retain(|dot| grid.has(*dot));
            dots.iter_mut().for_each(|dot| *dot = grid.cell(*dot));
        };
        snap(&mut self.marks);
        if !self.colours {
            snap(&mut self.background);
            snap(&mut self.foreground);
        }
        self.robot = self.robot.filter(|at| grid.has(*at)).map(|at| grid.cell(at));
        self.sensors.retain(|(x, y, _)| grid.has((*x, *y)));
        let labels = self.circles.iter_mut().filter_map(|circle| circle.label.as_mut());
        for (x, y, _) in labels.filter(|(x, y, _)| grid.has((*x, *y))).chain(&mut self.sensors) {
            (*x, *y) = grid.cell((*x, *y));
        }
    }

    fn paint(&self, context: &mut Context) {
        let colour = |colour| if self.colours { colour } else { Color::Reset };
        let draw = |context: &mut Context, coords: &Dots, color| context.draw(&Points { coords, color });
        if !self.colours {
            context.marker(Marker::Custom('.'));
        }
        draw(context, &self.background, colour(Color::DarkGray));
        context.marker(Marker::Braille);
        for circle in &self.circles {
            draw(context, &circle.dots, colour(circle.colour));
        }
        draw(context, &self.walls, Color::Reset);
        if !self.colours {
            context.marker(Marker::Custom('o'));
        }
        draw(context, &self.foreground, colour(Color::Magenta));
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
    }
}

/// `circle` as a dotted line, from the top on.
fn dotted(circle: &scene::Circle, dot_m: f64) -> Circle {
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

/// Dots between two of a circle.
const CIRCLE_DOTS: f64 = 3.0;
/// Circles of a smaller radius have no room for a label.
const LABEL_DOTS: f64 = 7.0;
