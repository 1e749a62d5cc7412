//! Quantities over a number of something, each beside the way in which it may grow: a table, a fit, a chart. Refuses to know
//! what was counted.

use crate::support::Outcome;
use crate::support::chart::{Chart, Point, Scale, Series};
use crate::support::figures::{self, Cell, percentile};
use crate::support::options::Options;

/// A quantity that was measured for each number.
pub(crate) struct Quantity {
    pub(crate) name: &'static str,
    pub(crate) unit: &'static str,
    /// The exponent that it has if the whole grows linearly: 0 for what each one costs, 1 for what all cost. Without one
    /// it is only shown.
    pub(crate) linear: Option<f64>,
}

/// A table of runs.
pub(crate) struct Sweep {
    title: String,
    /// What is counted.
    counted: &'static str,
    quantities: Vec<Quantity>,
    /// The numbers in their order, each with the runs' values by quantity.
    rows: Vec<(usize, Vec<Vec<f64>>)>,
}

/// How a quantity grows, from the medians of its runs.
#[derive(Clone, Copy, Debug)]
struct Growth {
    /// `fixed + each * n`, by least squares of relative errors.
    fixed: f64,
    each: f64,
    /// The slope of logarithms where numbers are great: 1 for what grows as they do.
    exponent: f64,
}

impl Sweep {
    /// An empty one.
    pub(crate) fn new(title: &str, counted: &'static str, quantities: Vec<Quantity>) -> Sweep {
        Sweep { title: title.to_owned(), counted, quantities, rows: Vec::new() }
    }

    /// Takes the values of one run with `number`: one for each quantity, in their order.
    pub(crate) fn add(&mut self, number: usize, values: &[f64]) {
        if self.rows.last().is_none_or(|(last, _)| *last != number) {
            self.rows.push((number, vec![Vec::new(); self.quantities.len()]));
        }
        if let Some((_, row)) = self.rows.last_mut() {
            row.iter_mut().zip(values).for_each(|(cell, value)| cell.push(*value));
        }
    }

    /// Prints all of it, and draws the first `drawn` quantities, which have one unit, to `file` of the directory that was
    /// asked for.
    pub(crate) fn tell(&self, options: &Options, drawn: usize, file: &str) -> Outcome<()> {
        figures::print_cells("scale", options.json, &self.cells());
        figures::print_cells("scale", options.json, &self.growths(options.json));
        if let Some(directory) = &options.draw {
            self.chart(drawn).write(&directory.join(file))?;
        }
        Ok(())
    }

    fn cells(&self) -> Vec<Cell> {
        let cell = |number: usize, quantity: &Quantity, values: &[f64]| Cell {
            table: self.title.clone(),
            row: format!("{number} {}", self.counted),
            column: quantity.name.to_owned(),
            unit: quantity.unit,
            values: values.to_vec(),
        };
        let row = |(number, row): &(usize, Vec<Vec<f64>>)| {
            let cells = self.quantities.iter().zip(row);
            cells.map(|(quantity, values)| cell(*number, quantity, values)).collect::<Vec<_>>()
        };
        self.rows.iter().flat_map(row).collect()
    }

    /// The fits; tells people what grows worse than linearly.
    fn growths(&self, json: bool) -> Vec<Cell> {
        let mut cells = Vec::new();
        for (at, quantity) in self.quantities.iter().enumerate() {
            let (Some(linear), Some(growth)) = (quantity.linear, Growth::of(&self.medians(at))) else {
                continue;
            };
            let columns = [
                ("fixed", quantity.unit, growth.fixed),
                ("for each", quantity.unit, growth.each),
                ("exponent", "1", growth.exponent),
                ("exponent of linear growth", "1", linear),
            ];
            cells.extend(columns.map(|(column, unit, value)| Cell {
                table: format!("growth, {}", self.title),
                row: quantity.name.to_owned(),
                column: column.to_owned(),
                unit,
                values: vec![value],
            }));
            if !json && growth.exponent > linear + BEYOND {
                println!("{}: {} grows WORSE THAN LINEARLY", self.title, quantity.name);
            }
        }
        cells
    }

    fn chart(&self, drawn: usize) -> Chart {
        let quantities = &self.quantities[..drawn];
        let series: Vec<Series> = quantities.iter().enumerate().map(|(at, _)| self.series(at)).collect();
        let unit = quantities.first().map_or("", |quantity| quantity.unit);
        Chart::new(&self.title, self.counted, unit).x(Scale::Log).y(Scale::Log).lines(&series)
    }

    fn series(&self, at: usize) -> Series {
        let point = |(number, row): &(usize, Vec<Vec<f64>>)| {
            let mut sorted = row[at].clone();
            sorted.sort_by(f64::total_cmp);
            let (least, most) = (*sorted.first()?, *sorted.last()?);
            Some(Point { x: *number as f64, y: percentile(&sorted, 0.5)?, least, most })
        };
        Series {
            name: self.quantities[at].name.to_owned(),
            points: self.rows.iter().filter_map(point).collect(),
        }
    }

    fn medians(&self, at: usize) -> Vec<(f64, f64)> {
        self.series(at).points.iter().map(|point| (point.x, point.y)).collect()
    }
}

impl Growth {
    /// Nothing for fewer than three numbers, or where something is zero.
    fn of(points: &[(f64, f64)]) -> Option<Growth> {
        let greatest = points.last()?.0;
        if points.len() < 3 || points.iter().any(|&(n, value)| n <= 0.0 || value <= 0.0) {
            return None;
        }
        let (fixed, each) = line(points.iter().map(|&(n, value)| (n, value, 1.0 / (value * value))))?;
        let far = points.iter().filter(|(n, _)| n * FAR >= greatest);
        let near = points.len().saturating_sub(3);
        // Three at least, or it would be the spread of two runs.
        let far: Vec<_> =
            if far.clone().count() < 3 { points[near..].to_vec() } else { far.copied().collect() };
        let (_, exponent) = line(far.iter().map(|(n, value)| (n.ln(), value.ln(), 1.0)))?;
        Some(Growth { fixed, each, exponent })
    }
}

/// The line `a + b x` nearest to points with their weights.
fn line(points: impl Iterator<Item = (f64, f64, f64)>) -> Option<(f64, f64)> {
    let [mut weights, mut x, mut y, mut xx, mut xy] = [0.0; 5];
    for (at, value, weight) in points {
        weights += weight;
        x += weight * at;
        y += weight * value;
        xx += weight * at * at;
        xy += weight * at * value;
    }
    let spread = weights * xx - x * x;
    let slope = (weights * xy - x * y) / spread;
    (spread > 0.0).then(|| ((y - slope * x) / weights, slope))
}

/// Numbers within this factor of the greatest one are great.
const FAR: f64 = 16.0;
/// An exponent that is so much greater than that of linear growth is no accident of a few runs.
const BEYOND: f64 = 0.25;
