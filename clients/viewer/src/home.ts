// The first page: twins, running sessions, recorded episodes.

import { Adder } from "./add";
import { count, el, fixed, messageOf, showStatus, showTitle } from "./dom";
import type { Page } from "./page";
import type { Pose } from "./pose";
import type { TwinInfo } from "./messages";
import { get, roleOfToken } from "./server";
import type { Role } from "./server";
import { isViewers } from "./session";
import { Thumbnails } from "./thumbnails";

interface Session {
  session: string;
  twin: string;
  version: number;
  step: number;
  pose: Pose;
  connected: boolean;
}

interface Episode {
  episode: string;
  twin: string;
  version: number;
  steps: number;
  time_us: number;
  modified_us?: number;
  scenario?: string;
  outcome?: string;
  verdict?: string;
}

const REFRESH_MS = 3000;

export class HomePage implements Page {
  readonly element = el("div.home");
  private readonly adder = new Adder(() => void this.load());
  private readonly twins = el("section");
  private readonly thumbnails = new Thumbnails((twin, scenario) => {
    this.scenarios.set(twin, scenario);
    void this.load();
  });
  /** The scenario that is chosen for a twin. */
  private readonly scenarios = new Map<string, string>();
  /** What the table of twins was made of. */
  private shownTwins = "";
  private readonly sessions = el("section");
  /** For tokens that cannot list sessions. */
  private readonly own = el("section", { hidden: true });
  private readonly episodes = el("section");
  /** The running sessions when the episodes were listed. */
  private listedFor: string | undefined;
  /** Whether they are listed once more: the record of a session that has just ended may still be written. */
  private listsAgain = false;
  /** The episodes that are chosen to be compared, during which the list stays. */
  private chosen: string[] = [];
  private timer = 0;
  private ended = false;

  constructor() {
    showTitle();
    this.adder.element.hidden = true;
    this.element.append(this.twins, this.adder.element, this.own, this.sessions, this.episodes,
      el("p.dim", {}, el("a", { href: "#/report" }, "Show the errors of a report on the map")));
    this.fillOwn();
    void this.load();
  }

  end(): void {
    this.ended = true;
    clearTimeout(this.timer);
    this.thumbnails.end();
  }

  private async load(): Promise<void> {
    clearTimeout(this.timer);
    try {
      const role = await roleOfToken();
      showTitle(...(role ? [`role of your token: ${role}`] : []));
      const { twins, damaged } = await get<{ twins: TwinInfo[]; damaged?: { name: string; reason: string }[] }>("v1/twins");
      this.showTwins(twins, damaged ?? [], role);
      this.adder.element.hidden = role === "drive";
      this.own.hidden = role === undefined || role === "admin";
      if (role === undefined || role === "admin") await this.loadSessions();
      if (!this.ended) showStatus("");
    } catch (error) {
      if (!this.ended) showStatus(messageOf(error), "bad");
    }
    if (!this.ended) this.timer = setTimeout(() => void this.load(), REFRESH_MS);
  }

  /** Sessions and episodes are listed for administrators alone. */
  private async loadSessions(): Promise<void> {
    const { sessions } = await get<{ sessions: Session[] }>("v1/sessions");
    this.showSessions(sessions);
    // The server opens every record for this list, so that it is read again only after a session has begun or ended.
    const running = sessions.map(({ session }) => session).join();
    const changed = running !== this.listedFor;
    if ((!changed && !this.listsAgain) || this.chosen.length > 0) return;
    const { episodes } = await get<{ episodes: Episode[] }>("v1/episodes");
    if (this.chosen.length > 0) return;
    this.showEpisodes(episodes);
    this.listedFor = running;
    this.listsAgain = changed;
  }

  /** The server lists sessions for administrators alone, but a token may watch its own ones by their names. */
  private fillOwn(): void {
    const field = el("input", { type: "text", placeholder: "session", spellcheck: false, ariaLabel: "session" });
    const form = el("form.watching", {}, field, el("button", { type: "submit" }, "Watch"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const name = field.value.trim();
      if (name) location.hash = `#/watch/${encodeURIComponent(name)}`;
    });
    this.own.append(el("h2", {}, "Your sessions"),
      el("p.dim", {}, "Sessions are listed for administrators. Your token can watch the sessions that it opened: give the name of one, or open the address #/watch/SESSION."), form);
  }

  private showTwins(twins: TwinInfo[], damaged: { name: string; reason: string }[], role: Role | undefined): void {
    // An open list of scenarios would close with each new table.
    const shown = JSON.stringify([twins, damaged, role, [...this.scenarios]]);
    if (shown === this.shownTwins) return;
    this.shownTwins = shown;
    const rows = twins.flatMap((twin) => {
      const recorded = twin.trajectories.map(({ name, length_m: length }) => `${name} ${fixed(length, 0)} m`).join(", ");
      const link = (kind: string, text: string): HTMLElement => el("a.action", { href: `#/${kind}/${twin.name}` }, text);
      const scenario = this.scenarios.get(twin.name);
      const drive = `#/drive/${twin.name}${scenario ? `/${encodeURIComponent(scenario)}` : ""}`;
      // Placing makes a version, which the role drive may not.
      const actions = [el("a.action", { href: drive }, "Drive"), link("fly", "Free camera"), ...(role === "drive" ? [] : [link("place", "Place a drive")])];
      const name = el("a.name", { href: drive }, twin.name);
      const row = el("tr", {}, el("td", {}, name), el("td.number", {}, `v${twin.version}`),
        el("td.number.count", {}, count(twin.gaussians)), el("td.drives", {}, recorded || "no recorded drive"), el("td.actions", {}, ...actions));
      return [row, el("tr.shown", {}, el("td", { colSpan: 5 }, this.thumbnails.of(twin)))];
    });
    const broken = damaged.map(({ name, reason }) => el("p.bad", {}, `${name} is damaged: ${reason}`));
    const head = ["twin", "version", "Gaussians", "recorded drives", ""].map((text) => el("th", {}, text));
    const table = rows.length
      ? el("table", {}, el("thead", {}, el("tr", {}, ...head)), el("tbody", {}, ...rows))
      : el("p", {}, "There is no twin on this server. `wildcity import` or `wildcity demo` makes one.");
    this.twins.replaceChildren(el("h2", {}, "Twins"), table, ...broken);
  }

  private showSessions(sessions: Session[]): void {
    const rows = sessions.filter(({ session }) => !isViewers(session)).map(({ session, twin, step, connected }) => el("tr", {},
      el("td", {}, session), el("td", {}, twin), el("td.number", {}, `step ${step}`),
      el("td", {}, connected ? "connected" : "waits to be resumed"),
      el("td.actions", {}, el("a.action", { href: `#/watch/${session}` }, "Watch"))));
    const table = rows.length ? el("table", {}, el("tbody", {}, ...rows)) : el("p.dim", {}, "None at the moment.");
    this.sessions.replaceChildren(el("h2", {}, "Running sessions"), table);
  }

  /** Two episodes can be chosen to be compared. */
  private showEpisodes(episodes: Episode[]): void {
    const drives = episodes.filter(({ episode, steps }) => !isViewers(episode) && steps > 0);
    const compare = el("a.action", { hidden: true }, "Compare");
    const { chosen } = this;
    const rows = drives.map((one) => {
      const box = el("input", { type: "checkbox", ariaLabel: `compare ${one.episode}` });
      box.addEventListener("change", () => {
        if (box.checked) chosen.push(one.episode);
        else chosen.splice(chosen.indexOf(one.episode), 1);
        compare.hidden = chosen.length !== 2;
        compare.href = `#/episode/${chosen.join("/")}`;
      });
      const when = one.modified_us ? new Date(one.modified_us / 1000).toLocaleString([], { dateStyle: "short", timeStyle: "short" }) : "";
      const result = [one.scenario, one.verdict ?? one.outcome?.replaceAll("_", " ")].filter(Boolean).join(": ");
      return el("tr", {}, el("td", {}, box), el("td", {}, el("a", { href: `#/episode/${one.episode}` }, one.episode)),
        el("td", {}, one.twin), el("td.number", {}, `${fixed(one.time_us * 1e-6, 1)} s`), el(one.verdict === "failed" ? "td.bad" : "td.drives", {}, result), el("td.number.dim", {}, when));
    });
    const table = rows.length ? el("table", {}, el("tbody", {}, ...rows)) : el("p.dim", {}, "None yet.");
    const hint = rows.length > 1 ? [el("p.dim", {}, "Open one, or choose two to see them side by side.")] : [];
    this.episodes.replaceChildren(el("h2", {}, "Recorded episodes ", compare), table, ...hint);
  }
}
