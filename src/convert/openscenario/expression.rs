//! Formulas of OpenSCENARIO: numbers, `$parameters`, `+ - * /` and parentheses.

use std::collections::BTreeMap;

/// Deepest nesting of parentheses.
const DEPTH: usize = 64;

/// The value of a formula.
pub(super) fn value(formula: &str, parameters: &BTreeMap<String, String>) -> Result<f64, String> {
    let mut parser = Parser { rest: formula.trim(), parameters, depth: 0 };
    let value = parser.sum()?;
    if !parser.rest.is_empty() {
        return Err(format!("{:?} is not read; + - * / and parentheses are", parser.rest));
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
            } else {
                return Ok(value);
            }
        }
    }

    fn factor(&mut self) -> Result<f64, String> {
        let mut sign = 1.0;
        while self.take('-') {
            sign = -sign;
        }
        if self.take('(') {
            self.depth += 1;
            if self.depth > DEPTH {
                return Err(format!("more than {DEPTH} parentheses"));
            }
            let value = self.sum()?;
            self.depth -= 1;
            return match self.take(')') {
                true => Ok(sign * value),
                false => Err("a closing parenthesis is missing".to_owned()),
            };
        }
        let is_parameter = self.rest.starts_with('$');
        let text = self.rest.strip_prefix('$').unwrap_or(self.rest);
        let end = match is_parameter {
            true => text.find(|c: char| !(c.is_alphanumeric() || c == '_')),
            false => text.find(|c: char| !(c.is_ascii_digit() || c == '.')),
        };
        let (word, rest) = text.split_at(end.unwrap_or(text.len()));
        self.rest = rest.trim_start();
        let number = match is_parameter {
            true => {
                let value = self.parameters.get(word);
                value.ok_or_else(|| format!("there is no parameter {word:?}; declare it"))?.as_str()
            }
            false => word,
        };
        let value: Option<f64> = number.parse().ok();
        value.map(|value| sign * value).ok_or_else(|| format!("{number:?} is not a number"))
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
        assert_eq!(of("-(2 - 5) * --2"), Ok(6.0));
        for wrong in ["", "1 +", "(1", "$other", "1 % 2", "1 / 0", "pow(2, 3)", "2 3"] {
            assert!(of(wrong).is_err(), "{wrong}");
        }
        assert!(of(&"(".repeat(100_000)).is_err());
    }
}
