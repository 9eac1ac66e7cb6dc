// The page of the address: #/, #/drive/TWIN, #/drive/TWIN/SCENARIO, #/fly/TWIN, #/place/TWIN, #/watch/SESSION, #/episode/NAME, #/episode/NAME/NAME,
// #/report.

import { byId, el, showStatus, showTitle } from "./dom";
import { DrivePage } from "./drive";
import { EpisodePage } from "./episode";
import { FlyPage } from "./fly";
import { HomePage } from "./home";
import type { Page } from "./page";
import { PlacePage } from "./place";
import { ReportPage } from "./report";
import { lacksToken, whenUnauthorized } from "./server";
import { TokenPage } from "./token";
import { WatchPage } from "./watch";

const THEME = "wildcity-theme";
const systemIsLight = matchMedia("(prefers-color-scheme: light)");

let page: Page | undefined;

function pageOf(address: string): Page {
  let names: string[];
  try {
    names = address.split("/").slice(1).map(decodeURIComponent);
  } catch {
    return damagedAddress(address);
  }
  const [kind = "", name = "", other] = names;
  if (kind === "report") return new ReportPage();
  if (lacksToken()) return new TokenPage(false, show);
  if (kind === "drive" && name) return new DrivePage(name, other);
  if (kind === "fly" && name) return new FlyPage(name);
  if (kind === "place" && name) return new PlacePage(name);
  if (kind === "watch" && name) return new WatchPage(name);
  if (kind === "episode" && name) return new EpisodePage(other ? [name, other] : [name]);
  return new HomePage();
}

function damagedAddress(address: string): Page {
  showTitle();
  showStatus("the address is damaged", "bad");
  const text = `The name in the address ${address} is damaged: a % is followed by something else than the bytes of a character.`;
  return { element: el("div.home", {}, el("p", {}, text), el("a.action", { href: "#/" }, "To the first page")), end: () => {} };
}

function show(): void {
  turnTo(() => pageOf(location.hash));
}

/** Ends the page that is shown before another one begins. */
function turnTo(make: () => Page): void {
  const old = page;
  page = undefined;
  void old?.end();
  page = make();
  byId("page").replaceChildren(page.element);
}

/** The theme that the user chose, else the system's. */
function applyTheme(): void {
  document.documentElement.dataset.theme = localStorage.getItem(THEME) ?? (systemIsLight.matches ? "light" : "dark");
}

whenUnauthorized((hadToken) => {
  // Several requests may be refused together.
  if (!(page instanceof TokenPage)) turnTo(() => new TokenPage(hadToken, show));
});
byId("theme").addEventListener("click", () => {
  localStorage.setItem(THEME, document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  applyTheme();
});
systemIsLight.addEventListener("change", applyTheme);
addEventListener("hashchange", show);
addEventListener("pagehide", () => void page?.end());
applyTheme();
show();
