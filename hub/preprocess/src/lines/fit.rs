//! Fit of the likeliest line for some beams whose noise is along the beams.
//!
//! A line is a pair of numbers (a, b): a beam in the direction (cos, sin) meets the line at the range
//! 1 / (a cos + b sin). This is the normal form r = cos (t - alpha) * range, with a = cos alpha / r and
//! b = sin alpha / r.
//!
//! Ranges have normal noise along their beams. The likeliest line therefore has the minimum sum of squares of (measured
//! range - range of the line). This difference is not linear in a and b. The expression range^2 (a cos + b sin) - range
//! is linear, and differs from the difference only by the factor measured / true range. Its sums are updated beam by
//! beam ([`Sums`]), and define a first line. A few Gauss-Newton steps lead from the first line to the likeliest line
//! ([`LineEquation::refined`]).

/// A beam that has a range: its direction as a unit vector, and its range in meters.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Ray {
    pub(super) cos: f64,
    pub(super) sin: f64,
    pub(super) range: f64,
}

impl Ray {
    /// Returns the distance between the ends of two rays in meters.
    pub(super) fn distance(&self, other: &Ray) -> f64 {
        let (x, y) = (
            self.range * self.cos - other.range * other.cos,
            self.range * self.sin - other.range * other.sin,
        );
        (x * x + y * y).sqrt()
    }
}

/// A line as the numbers a and b of this module, in 1/m. They are the inverses of the ranges at which beams along x and
/// along y meet the line.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct LineEquation {
    pub(super) a: f64,
    pub(super) b: f64,
}

impl LineEquation {
    /// Returns the inverse of the range at which `ray` meets the line. It is not positive if the ray does not meet the
    /// line.
    pub(super) fn inverse(&self, ray: &Ray) -> f64 {
        self.a * ray.cos + self.b * ray.sin
    }

    /// Returns the sum of the squared differences between the ranges of `rays` and the ranges at which they meet the
    /// line, in m2. It is infinite if a ray does not meet the line.
    pub(super) fn error(&self, rays: &[Ray]) -> f64 {
        let mut sum = 0.0;
        for ray in rays {
            let inverse = self.inverse(ray);
            if inverse <= MIN_INVERSE_RANGE {
                return f64::INFINITY;
            }
            let off = ray.range - 1.0 / inverse;
            sum += off * off;
        }
        sum
    }

    /// Returns the line through the ends of two rays.
    pub(super) fn through(first: &Ray, last: &Ray) -> LineEquation {
        let det = first.cos * last.sin - first.sin * last.cos;
        let (one, two) = (1.0 / first.range, 1.0 / last.range);
        LineEquation {
            a: (one * last.sin - two * first.sin) / det,
            b: (two * first.cos - one * last.cos) / det,
        }
    }

    /// Returns a line that is at most `steps` steps from this line toward the likeliest line for `rays`, and its error.
    pub(super) fn refined(self, rays: &[Ray], steps: usize) -> (LineEquation, f64) {
        let (mut line, mut error) = (self, self.error(rays));
        if let [first, .., last] = rays {
            // If beams meet a surface at a very flat angle, the line of the sums may be behind the sensor. Try the line
            // through the first and the last ray, too.
            let through = LineEquation::through(first, last);
            let alternative = through.error(rays);
            if alternative < error {
                (line, error) = (through, alternative);
            }
        }
        for _ in 0..steps {
            let Some(information) = Information::of(&line, rays) else { break };
            let (da, db) = information.step();
            let (mut part, previous_error) = (1.0, error);
            while part > 0.1 {
                let next = LineEquation { a: line.a + part * da, b: line.b + part * db };
                let reached = next.error(rays);
                if reached < error {
                    (line, error) = (next, reached);
                    break;
                }
                part *= 0.5;
            }
            if previous_error - error <= 1e-4 * error {
                break;
            }
        }
        (line, error)
    }
}

/// Inverse of a range that no scanner reaches: 10 km.
const MIN_INVERSE_RANGE: f64 = 1e-4;

/// Information of rays about a line, for a Gauss-Newton step and the covariance. The derivatives are those of the range
/// at which a ray meets the line, with respect to a and b.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Information {
    /// Sums of the products of two derivatives.
    aa: f64,
    ab: f64,
    bb: f64,
    /// Sums of the products of a derivative and the difference between the measured range and the line.
    a: f64,
    b: f64,
}

impl Information {
    /// Returns the information of `rays` about `line`, or `None` if a ray does not meet the line.
    pub(super) fn of(line: &LineEquation, rays: &[Ray]) -> Option<Information> {
        let mut sums = Information::default();
        for ray in rays {
            let inverse = line.inverse(ray);
            if inverse <= MIN_INVERSE_RANGE {
                return None;
            }
            let range = 1.0 / inverse;
            let (off, square) = (ray.range - range, range * range);
            let (by_a, by_b) = (-square * ray.cos, -square * ray.sin);
            sums.aa += by_a * by_a;
            sums.ab += by_a * by_b;
            sums.bb += by_b * by_b;
            sums.a += by_a * off;
            sums.b += by_b * off;
        }
        Some(sums)
    }

    /// Returns the covariance of a and b, as its elements aa, ab and bb, if a range has this `variance`. Returns `None`
    /// if all rays have the same direction.
    pub(super) fn inverse(&self, variance: f64) -> Option<(f64, f64, f64)> {
        let (product, det) = (self.aa * self.bb, self.aa * self.bb - self.ab * self.ab);
        let scale = variance / det;
        (det > 1e-12 * product && scale.is_finite()).then_some((
            scale * self.bb,
            -scale * self.ab,
            scale * self.aa,
        ))
    }

    fn step(&self) -> (f64, f64) {
        let det = self.aa * self.bb - self.ab * self.ab;
        ((self.bb * self.a - self.ab * self.b) / det, (self.aa * self.b - self.ab * self.a) / det)
    }
}

/// Sums over rays, from which the line with the minimum error of the linear expression is computed. The error of this
/// line is computed from them, too.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sums {
    cc: f64,
    cs: f64,
    ss: f64,
    c: f64,
    s: f64,
    square: f64,
    count: f64,
}

impl Sums {
    /// Returns the sums over `rays`.
    pub(super) fn of(rays: &[Ray]) -> Sums {
        rays.iter().fold(Sums::default(), |sums, ray| sums + Sums::one(ray))
    }

    /// Returns the sums over one ray.
    pub(super) fn one(ray: &Ray) -> Sums {
        let square = ray.range * ray.range;
        let (c, s) = (square * ray.cos, square * ray.sin);
        Sums { cc: c * c, cs: c * s, ss: s * s, c: c * ray.range, s: s * ray.range, square, count: 1.0 }
    }

    /// Returns the line with the minimum error.
    pub(super) fn line(&self) -> LineEquation {
        let det = self.cc * self.ss - self.cs * self.cs;
        LineEquation {
            a: (self.ss * self.c - self.cs * self.s) / det,
            b: (self.cc * self.s - self.cs * self.c) / det,
        }
    }

    /// Returns the error of the line with the minimum error, in m2.
    pub(super) fn error(&self) -> f64 {
        if self.count < 2.5 {
            return 0.0;
        }
        let LineEquation { a, b } = self.line();
        (self.square - a * self.c - b * self.s).max(0.0)
    }

    #[inline]
    fn combined(self, other: Sums, combine: impl Fn(f64, f64) -> f64) -> Sums {
        Sums {
            cc: combine(self.cc, other.cc),
            cs: combine(self.cs, other.cs),
            ss: combine(self.ss, other.ss),
            c: combine(self.c, other.c),
            s: combine(self.s, other.s),
            square: combine(self.square, other.square),
            count: combine(self.count, other.count),
        }
    }
}

impl std::ops::Add for Sums {
    type Output = Sums;

    fn add(self, other: Sums) -> Sums {
        self.combined(other, |one, other| one + other)
    }
}

impl std::ops::Sub for Sums {
    type Output = Sums;

    fn sub(self, other: Sums) -> Sums {
        self.combined(other, |one, other| one - other)
    }
}
