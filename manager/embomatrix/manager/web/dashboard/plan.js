// Floor plan of a scene, north up, with the course of a plan.
import {h, shape} from "./dom.js";

const KEY = [["robot", "robot"], ["way", "path"], ["goal", "goal object"], ["thing", "other small object"], ["held", "held"], ["active", "open or on"]];
const MARGIN_M = 0.3, UNIT = 100, ROBOT_M = 0.22, DOT_M = 0.09;

/** Drawing of the named rooms, or of all. `about` are goal objects, `things` small objects with their positions. */
export function drawn(floor, {rooms, about = new Set(), things = {}, label: words}) {
  const shown = floor.rooms.filter(([name]) => !rooms || rooms.includes(name)), seen = shown.length ? shown : floor.rooms;
  const west = Math.min(...seen.map(r => r[1])) - MARGIN_M, south = Math.min(...seen.map(r => r[2])) - MARGIN_M;
  const east = Math.max(...seen.map(r => r[3])) + MARGIN_M, north = Math.max(...seen.map(r => r[4])) + MARGIN_M;
  const x = metres => Math.round((metres - west) * UNIT), y = metres => Math.round((north - metres) * UNIT);
  const box = (kind, [name, left, low, right, high]) => shape("rect", {class: kind, x: x(left), y: y(high), width: Math.max(2, x(right) - x(left)), height: Math.max(2, y(low) - y(high))}, name && shape("title", {}, name));
  /** A room's name, in the corner where it covers the fewest objects. */
  const label = ([name, left, low, right, high]) => {
    const wide = name.length * large * 0.6, spots = Object.values(things).map(([east_m, north_m]) => [x(east_m), y(north_m)]);
    const corners = [[x(left) + 8, y(high) + large + 6], [x(left) + 8, y(low) - 8], [x(right) - 8 - wide, y(high) + large + 6], [x(right) - 8 - wide, y(low) - 8]];
    const hidden = ([at_x, at_y]) => spots.filter(([px, py]) => px > at_x - 12 && px < at_x + wide + 12 && py > at_y - large - 12 && py < at_y + 12).length;
    const [at_x, at_y] = corners.reduce((best, corner) => hidden(corner) < hidden(best) ? corner : best);
    return shape("text", {class: "name", x: Math.round(at_x), y: Math.round(at_y), "font-size": large}, name);
  };
  const within = ([, left, low, right, high]) => left < east && right > west && low < north && high > south;
  const robot = shape("circle", {class: "robot", r: ROBOT_M * UNIT}, shape("title", {}, "robot")), way = shape("polyline", {class: "way"});
  const dots = Object.fromEntries(Object.keys(things).map(name => [name, shape("circle", {class: about.has(name) ? "thing goal" : "thing", r: DOT_M * UNIT}, shape("title", {}, name))]));
  const names = new Set(Object.keys(things)), large = Math.round(Math.max(x(east), y(south)) / 45);
  const picture = shape("svg", {class: "floor", style: `--wide:${(x(east) / y(south)).toFixed(3)}`, viewBox: `0 0 ${x(east)} ${y(south)}`, role: "img", "aria-label": words},
    seen.map(room => box("room", room)), floor.pieces.filter(piece => within(piece) && !names.has(piece[0])).map(piece => box(about.has(piece[0]) ? "piece goal" : "piece", piece)),
    floor.walls.filter(within).map(wall => box("wall", wall)),
    rooms ? seen.map(room => label(room)) : [],
    rooms ? [way, robot, ...Object.values(dots)] : []);
  const key = rooms ? h("p", {class: "legend"}, KEY.map(([mark, words]) => [h("i", {class: `key ${mark}`}), words])) : null;
  const put = (mark, [east_m, north_m]) => { mark.setAttribute("cx", x(east_m)); mark.setAttribute("cy", y(north_m)); };
  return {
    picture,
    /** Legend of the marks. */
    key,
    /** Show the plan up to that moment. */
    show(moments, number) {
      const moment = moments[number];
      put(robot, moment.robot);
      way.setAttribute("points", moments.slice(0, number + 1).map(({robot: [e, n]}) => `${x(e)},${y(n)}`).join(" "));
      for (const [name, mark] of Object.entries(dots)) {
        put(mark, moment.things[name] ?? things[name]);
        mark.classList.toggle("held", moment.held.includes(name));
      }
      for (const rect of picture.querySelectorAll("rect.piece")) rect.classList.toggle("active", moment.active.includes(rect.textContent));
    },
  };
}
