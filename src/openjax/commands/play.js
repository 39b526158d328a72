"use strict";
// The replay's page made live (openjax.commands.play_server): frames arrive as events and are
// appended to the episode that the page draws; keys or the mouse say where the evader wants to go.
$("time").style.display = "none";
$("controls").replaceChildren(...["told"].map($));
const score = document.createElement("span"), replay = document.createElement("a");
replay.href = "/replay"; replay.target = "_blank"; replay.style.display = "none"; replay.textContent = "replay of this game";
const mouseLabel = document.createElement("label"), mouse = document.createElement("input");
mouse.type = "checkbox"; mouse.id = "mouse";
mouseLabel.append(mouse, " follow the mouse");
$("controls").append(score, replay, mouseLabel);
const help = document.createElement("div");
help.style.cssText = "padding: 0 1em .7em; color: var(--dim); font-size: 14px";
help.textContent = "You are the red evader. Arrow keys fly, W up, S down, space begins a game. Drag to turn the view.";
document.body.append(help);

const pressed = new Set();
let message = "press space to begin", over = true, pointer = null, previous = "";
playing = false;

function post(path, body) { fetch(path, { method: "POST", body }).catch(() => { message = "the program has ended"; }); }

function wish() {
  const axis = (plus, minus) => (pressed.has(plus) ? 1 : 0) - (pressed.has(minus) ? 1 : 0);
  const ahead = axis("ArrowUp", "ArrowDown"), right = axis("ArrowRight", "ArrowLeft"), up = axis("w", "s");
  const [ca, sa] = [Math.cos(azimuth), Math.sin(azimuth)];
  // ahead is away from the eye, right is the picture's right
  let towards = [-ca * ahead - sa * right, -sa * ahead + ca * right];
  if (mouse.checked && pointer && !ahead && !right) {
    // along the picture from the evader to the pointer, full speed from a tenth of a metre on
    const w = scene.clientWidth, h = scene.clientHeight, p = at(flight.evader, flight.steps - 1, 3);
    const [x, y, , f] = camera(w, h).see(p), flat = Math.max(Math.sin(elevation), 0.2);
    const dx = (pointer[0] - x) / f, dy = (y - pointer[1]) / (f * flat), size = Math.max(0.1, Math.hypot(dx, dy));
    towards = [(-ca * dy - sa * dx) / size, (-sa * dy + ca * dx) / size];
  }
  return [...towards, up].map(value => Math.round(1000 * value) / 1000);
}
function send() {
  const text = JSON.stringify(wish());
  if (!over && text !== previous) { previous = text; post("/wish", text); }
}
setInterval(send, 40);

addEventListener("keydown", e => {
  const key = e.key.length === 1 ? e.key.toLowerCase() : e.key;
  if (key === " ") { e.preventDefault(); e.stopImmediatePropagation(); if (over) post("/start", ""); return; }
  if (key.startsWith("Arrow")) e.preventDefault();
  pressed.add(key); send();
}, true);
addEventListener("keyup", e => { pressed.delete(e.key.length === 1 ? e.key.toLowerCase() : e.key); send(); });
addEventListener("blur", () => { pressed.clear(); send(); });
scene.addEventListener("pointermove", e => { const box = scene.getBoundingClientRect(); pointer = [e.clientX - box.left, e.clientY - box.top]; });
scene.addEventListener("dblclick", () => { if (over) post("/start", ""); });

new EventSource("/events").onmessage = event => {
  const news = JSON.parse(event.data);
  if (news.start) {
    flight = news.start; flights[0] = flight; time = 0; previous = "";
    over = true; message = "press space to begin";
  }
  if (news.frame) {
    over = false;
    const k = flight.steps;
    news.frame.pursuers.forEach((pose, i) => {
      flight.pursuers[i].push(...pose);
      if (news.frame.crashed[i] && flight.crashes[i] === null) flight.crashes[i] = k;
    });
    flight.evader.push(...news.frame.evader);
    flight.steps = k + 1; time = k * flight.dt + 1e-6;
    message = news.frame.seen ? "they see you" : "hidden";
  }
  if (news.end) {
    over = true; pressed.clear();
    if (news.end.captured) flight.capture = flight.steps - 1;
    message = (news.end.captured ? `caught after ${news.end.seconds} s` : `escaped for ${news.end.seconds} s`) + " · space: the next game";
    score.textContent = `caught in ${news.end.captures} of ${news.end.games} · longest ${news.end.longest} s`;
    replay.style.display = "";
  }
};
const drawReplay = draw;
draw = function () { drawReplay(); $("told").textContent = `${time.toFixed(1)} s · ${message}`; };
