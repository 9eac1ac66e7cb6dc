//! Formulas of OpenSCENARIO: numbers, `$parameters`, `+ - * / %`, parentheses, and functions.

use std::collections::BTreeMap;

/// Deepest nesting of parentheses.
const DEPTH: usize = 64;

/// A text of an attribute with its parameters put in: as it is, a parameter `$name`, or a formula
/// `${..}`.
pub(super) fn text(text: &str, parameters: &BTreeMap<String, String>) -> Result<String, String> {
    let Some(rest) = text.strip_prefix('$') else { return Ok(text.to_owned()) };
    let formula = rest.strip_prefix('{').and_then(|rest| rest.strip_suffix('}'));
    let Some(formula) = formula else { return parameter(rest, parameters).map(str::to_owned) };
    // A parameter alone may be any text.
    match formula.trim().strip_prefix('$').filter(|name| name.chars().all(is_in_name)) {
        Some(name) => parameter(name, parameters).map(str::to_owned),
        None => value(formula, parameters).map(|value| value.to_string()),
    }
}

fn parameter<'a>(name: &str, parameters: &'a BTreeMap<String, String>) -> Result<&'a str, String> {
    let value = parameters.get(name);
    value.map(String::as_str).ok_or_else(|| format!("there is no parameter {name:?}; declare it"))
}

fn is_in_name(symbol: char) -> bool {
    symbol.is_alphanumeric() || symbol == '_'
}

/// The value of a formula.
pub(super) fn value(formula: &str, parameters: &BTreeMap<String, String>) -> Result<f64, String> {
    // By recursive descent: a sum has products, and a product has factors, so that `*` binds before
    // `+`.
    let mut parser = Parser { rest: formula.trim(), parameters, depth: 0 };
    let value = parser.sum()?;
    // A formula must be the whole text.
    if !parser.rest.is_empty() {
        return Err(format!("{:?} is not read; + - * / % and parentheses are", parser.rest));
    }
    if value.is_finite() { Ok(value) } else { Err("is not finite".to_owned()) }
}

struct Parser<'a> {
    rest: &'a str,
    parameters: &'a BTreeMap<String, String>,
    depth: usize,
}

impl Parser<'_> {
    fn take(&mut self, symbol: char) -> bool {
        let Some(rest) = self.rest.strip_prefix(symbol) else { return false };
        self.rest = rest.trim_start();
        true
    }

    fn sum(&mut self) -> Result<f64, String> {
        let mut value = self.product()?;
        loop {
            if self.take('+') {
                value += self.product()?;
            } else if self.take('-') {
                value -= self.product()?;
            } else {
                return Ok(value);
            }
        }
    }

    fn product(&mut self) -> Result<f64, String> {
        let mut value = self.factor()?;
        loop {
            if self.take('*') {
                value *= self.factor()?;
            } else if self.take('/') {
                value /= self.factor()?;
            } else if self.take('%') {
                value %= self.factor()?;
            } else {
                return Ok(value);
            }
        }
    }

    fn factor(&mut self) -> Result<f64, String> {
        let mut sign = 1.0;
        // A loop and no recursion, because a text may have any number of signs.
        while self.take('-') {
            sign = -sign;
        }
        if self.take('(') {
            return Ok(sign * self.arguments::<1>()?[0]);
        }
        let is_parameter = self.rest.starts_with('$');
        let text = self.rest.strip_prefix('$').unwrap_or(self.rest);
        if !is_parameter && text.starts_with(|c: char| c.is_ascii_alphabetic()) {
            return Ok(sign * self.function()?);
        }
        let end = if is_parameter {
            text.find(|c: char| !is_in_name(c))
        } else {
            Some(number_length(text))
        };
        let (word, rest) = text.split_at(end.unwrap_or(text.len()));
        self.rest = rest.trim_start();
        let number = if is_parameter { parameter(word, self.parameters)? } else { word };
        let value: Option<f64> = number.trim().parse().ok();
        value.map(|value| sign * value).ok_or_else(|| format!("{number:?} is not a number"))
    }

    /// Values up to a closing parenthesis.
    fn arguments<const N: usize>(&mut self) -> Result<[f64; N], String> {
        // Each parenthesis is one level of recursion. The bound keeps the stack small.
        self.depth += 1;
        if self.depth > DEPTH {
            return Err(format!("more than {DEPTH} parentheses"));
        }
        let mut values = [0.0; N];
        for (index, value) in values.iter_mut().enumerate() {
            if index > 0 && !self.take(',') {
                return Err("a comma is missing".to_owned());
            }
            *value = self.sum()?;
        }
        self.depth -= 1;
        if self.take(')') { Ok(values) } else { Err("a closing parenthesis is missing".to_owned()) }
    }

    fn function(&mut self) -> Result<f64, String> {
        let end = self.rest.find(|c: char| !c.is_ascii_alphabetic()).unwrap_or(self.rest.len());
        let (name, rest) = self.rest.split_at(end);
        self.rest = rest.trim_start();
        if name == "pi" {
            return Ok(std::f64::consts::PI);
        }
        if !self.take('(') {
            return Err(format!("{name:?} is not a number"));
        }
        Ok(match name {
            "round" => self.arguments::<1>()?[0].round(),
            "floor" => self.arguments::<1>()?[0].floor(),
            "ceil" => self.arguments::<1>()?[0].ceil(),
            "sqrt" => self.arguments::<1>()?[0].sqrt(),
            "abs" => self.arguments::<1>()?[0].abs(),
            // `signum` would make 1 of it.
            "sign" => match self.arguments::<1>()?[0] {
                0.0 => 0.0,
                value => value.signum(),
            },
            "pow" => {
                let [base, exponent] = self.arguments()?;
                base.powf(exponent)
            }
            "min" => {
                let [a, b] = self.arguments()?;
                a.min(b)
            }
            "max" => {
                let [a, b] = self.arguments()?;
                a.max(b)
            }
            _ => return Err(format!("there is no function {name:?}")),
        })
    }
}

/// The length of the number at the start of a text, in bytes: with an exponent, whose sign is no
/// sum.
fn number_length(text: &str) -> usize {
    let is_digit = |c: char| c.is_ascii_digit() || c == '.';
    let end = text.find(|c: char| !is_digit(c)).unwrap_or(text.len());
    // Only a sign after the letter belongs to the number: `2e1-1` is 20 - 1.
    let Some(exponent) = text[end..].strip_prefix(['e', 'E']) else { return end };
    let digits = exponent.strip_prefix(['+', '-']).unwrap_or(exponent);
    let length = digits.find(|c: char| !c.is_ascii_digit()).unwrap_or(digits.len());
    match (end, length) {
        // Without digits on both sides, the letter is no exponent.
        (0, _) | (_, 0) => end,
        _ => text.len() - digits.len() + length,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_have_their_usual_precedence() {
        let parameters = BTreeMap::from([("speed".to_owned(), "36".to_owned())]);
        let of = |formula: &str| value(formula, &parameters);
        assert_eq!(of("$speed / 3.6"), Ok(10.0));
        assert_eq!(of("1 + 2 * 3 - 4 / 2"), Ok(5.0));
        // -(-3) * 2, then 3 + 20 - 1, then 8 + 6 + 1 - 1, then 3 * -1 + 1 + 3.
        assert_eq!(of("-(2 - 5) * --2"), Ok(6.0));
        assert_eq!(of("7 % 4 + 2e1-1"), Ok(22.0));
        assert_eq!(of("pow(2, 3) + sqrt($speed) + max(1, -2) + sign(-5)"), Ok(14.0));
        assert_eq!(of("round(2.5) * floor(-0.5) + ceil(0.1) + abs(-3)"), Ok(1.0));
        for wrong in
            ["", "1 +", "(1", "$other", "1 / 0", "pow(2)", "pow(2, 3", "2 3", "log(2)", "e"]
        {
            assert!(of(wrong).is_err(), "{wrong}");
        }
        assert!(of(&"(".repeat(100_000)).is_err());
        assert!(of(&"sqrt(".repeat(100_000)).is_err());
    }

    #[test]
    fn a_parameter_alone_may_be_any_text() {
        let parameters = BTreeMap::from([("model".to_owned(), "car".to_owned())]);
        assert_eq!(text("${$model}", &parameters), Ok("car".to_owned()));
        assert_eq!(text("$model", &parameters), Ok("car".to_owned()));
        assert_eq!(text("${2 * 3}", &parameters), Ok("6".to_owned()));
        assert!(text("${$model + 1}", &parameters).is_err());
    }
}
