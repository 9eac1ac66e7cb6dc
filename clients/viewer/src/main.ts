// The page of the address: #/, #/drive/TWIN, #/fly/TWIN, #/place/TWIN, #/watch/SESSION, #/episode/NAME, #/episode/NAME/NAME.

import { byId } from "./dom";
import { DrivePage } from "./drive";
import { EpisodePage } from "./episode";
import { FlyPage } from "./fly";
import { HomePage } from "./home";
import type { Page } from "./page";
import { PlacePage } from "./place";
import { WatchPage } from "./watch";

const THEME = "wildcity-theme";
const systemIsLight = matchMedia("(prefers-color-scheme: light)");

let page: Page | undefined;

function pageOf(address: string): Page {
  const [, kind = "", ...names] = address.split("/").map(decodeURIComponent);
  const name = names[0] ?? "";
  if (kind === "drive" && name) return new DrivePage(name);
  if (kind === "fly" && name) return new FlyPage(name);
  if (kind === "place" && name) return new PlacePage(name);
  if (kind === "watch" && name) return new WatchPage(name);
  if (kind === "episode" && name) return new EpisodePage(names.slice(0, 2));
  return new HomePage();
}

function show(): void {
  void page?.end();
  page = pageOf(location.hash);
  byId("page").replaceChildren(page.element);
}

/** The theme that the user chose, else the system's. */
function applyTheme(): void {
  document.documentElement.dataset.theme = localStorage.getItem(THEME) ?? (systemIsLight.matches ? "light" : "dark");
}

byId("theme").addEventListener("click", () => {
  localStorage.setItem(THEME, document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  applyTheme();
});
systemIsLight.addEventListener("change", applyTheme);
addEventListener("hashchange", show);
addEventListener("pagehide", () => void page?.end());
applyTheme();
show();
