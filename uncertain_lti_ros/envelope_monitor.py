# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`envelope_monitor`: the lifecycle node that watches live topics; parameters, QoS, clocks and messages only."""

from __future__ import annotations

import gc
import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.executors import MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from uncertain_lti.base.errors import ModelError, UncertainLTIError
from uncertain_lti.base.text import shortlist
from uncertain_lti.monitor.intake import Intake
from uncertain_lti.monitor.outputs import VIOLATION
from uncertain_lti.monitor.session import ERROR, STALE, WARN, EventLog, Failures, Report, Rule, Session
from uncertain_lti.signals.field_path import full_name
from uncertain_lti_ros.parameters import DEFAULTS, PARAMETERS, RULE, Settings, make_session
from uncertain_lti_ros.process import BAD_USAGE, declare, living, run_node, spare_the_middleware, whole_to_real
from uncertain_lti_ros.snapshot_writer import Snapshots
from uncertain_lti_ros.topics import CLOCK, POLL, Diagnostics, MatchedSubscription, Outputs, SimulatedTime, input_values

NAME = "envelope_monitor"
_SUMMARY = (
    "Watches the topics that a model file names and publishes, per sample, whether each state lies within its bounds; "
    "~/violation is the alarm. Needs the parameter model. Services: ~/status, ~/reset, ~/reload, ~/snapshot "
    "(std_srvs/srv/Trigger) and those of a managed node."
)
_TICK = 0.2  # s between two runs of the periodic tasks
_LOOK = 1.0  # s between two looks at the graph; events of the middleware bring it forward
_NOTE = 0.05  # s between two checks for changes to log
_LAST_WORDS = 1.0  # s that the end waits until readers of /diagnostics have the last report

_NAMES = ("configure", "cleanup", "activate", "deactivate")
_TRANSITIONS = {getattr(Transition, f"TRANSITION_{name.upper()}"): name for name in _NAMES}


def _failures_noted(transition: Callable[..., TransitionCallbackReturn]) -> Callable[..., TransitionCallbackReturn]:
    """A transition whose unexpected errors are counted and logged; rclpy itself ignores them silently."""

    @wraps(transition)
    def noting(node: EnvelopeMonitorNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception as error:
            node.note_failure(f"in {transition.__name__}", error)
            return TransitionCallbackReturn.ERROR

    return noting


class EnvelopeMonitorNode(LifecycleNode):
    """Managed node around `Session`; the page on the live node describes its topics, services and parameters.

    Public for tests and programs around it: `session` (None while not configured), `active` (verdicts are given),
    `reason` (why the last configure failed), `clock`, `settings`, `inputs` by topic, `outputs`, `snapshots` and
    `failures`.

    Several may be in one process, on one `EventsExecutor`. `start` configures and activates; the program does that if
    `autostart` is true, others decide for themselves.

    `name`: of the node; `**options`: of `rclpy.node.Node`: `namespace`, `parameter_overrides`, `context`, `cli_args`,
    `use_global_arguments` and so on.
    """

    def __init__(self, name: str = NAME, **options: Any) -> None:
        super().__init__(name, **options)
        declare(self, PARAMETERS)
        self.settings = Settings(self)
        self.reason = ""
        self._starts_itself = False  # autostart was asked for and has not succeeded yet
        self.inputs: dict[str, MatchedSubscription] = {}
        self._enable_problem, self._twin, self._clocks = "", False, 0
        self._candidate: Session | Rule | None = None  # accepted, not yet in place
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)  # a paused or looping simulation must not stop these
        self._looked = self._reported = time.monotonic()
        self.outputs = Outputs(self, self._looked)
        self.failures = Failures(self.get_logger().error)
        self.note_failure = self.failures.note
        self.clock: ROSClock = self.get_clock()  # type: ignore[assignment]  # stated too narrowly in rclpy
        self.snapshots = Snapshots(self, self.settings)
        self._event_log = EventLog(self._log)
        self.intake = Intake(self.outputs.sender, self.snapshots, self._event_log.turned, self.note_failure)
        self._simulated: SimulatedTime | None = None
        self._look_at_clock()
        self._noted = 0.0
        self._diagnostics = Diagnostics(self, self.settings["hardware_id"])
        services: dict[str, Callable[[], tuple[bool, str]]] = {
            "status": self._on_status, "reset": self._on_reset, "reload": self._on_reload,
            "snapshot": lambda: (True, self.snapshots.write(self.session)),
        }  # fmt: skip
        for name, serve in services.items():
            self.create_service(Trigger, f"~/{name}", partial(self._serve, serve))
        self.add_pre_set_parameters_callback(lambda given: [whole_to_real(p, DEFAULTS.get(p.name)) for p in given])
        self.add_on_set_parameters_callback(self._on_set)
        self.add_post_set_parameters_callback(self._on_have_set)
        tick = min(_TICK, self.settings["heartbeat"] / 4, self.settings["diagnostics_period"] / 2)
        self.create_timer(tick, self.tick, clock=self._steady)
        self.create_timer(POLL, self._on_poll, clock=self._steady)
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state

    @property
    def session(self) -> Session | None:
        """What judges; None while not configured."""
        session: Session | None = self.intake.session
        return session

    @property
    def active(self) -> bool:
        """Whether verdicts are given."""
        return self.intake.active

    # --- parameters ---

    @property
    def _timeout(self) -> float:
        """s without a verdict that are silence."""
        least: float = self.settings["state_timeout"]
        return max(least, self.session.between_verdicts) if self.session else least

    def _make_session(self, settings: Settings) -> Session:
        return make_session(settings, self.session.arming if self.session else None)

    def _on_set(self, parameters: Iterable[Parameter]) -> SetParametersResult:
        """Prepare what the new values require, or refuse them; `_on_have_set` puts it in place."""
        given = {p.name: p.value for p in parameters}
        self._candidate, settings = None, copy(self.settings)
        settings.update(given)
        try:
            self.settings.check_snapshots(given.get("snapshot.on_alarm", False))
            if "model" in given:
                self._candidate = self._make_session(settings)
            elif given.keys() & {*RULE}:
                rule = settings.rule()
                if self.session is not None:
                    self.session.check(rule)
                self._candidate = rule
        except UncertainLTIError as error:
            self.get_logger().warning(f"parameters refused: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:  # a file can be wrong in unexpected ways
            self.note_failure("while parameters were set", error)
            return SetParametersResult(successful=False, reason=f"unexpected: {error!r}")
        return SetParametersResult(successful=True)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """As of `Node`; what is accepted and may keep alarms off is the reason of the answer."""
        result = super().set_parameters_atomically(parameter_list)
        if result.successful and any(parameter.name == "enable" for parameter in parameter_list):
            result.reason = self._enable_problem
        return result

    def _on_have_set(self, parameters: Sequence[Parameter]) -> None:
        self.settings.read()
        self._look_at_clock()
        candidate, self._candidate = self._candidate, None
        if isinstance(candidate, Rule) and self.session is not None:
            if candidate == self.session.rule:
                return
            self.session.follow(candidate)
            self.outputs.prepare(self.session)
            self._event_log.turned(self.session, (), time.monotonic(), ", as its rule has changed")
            self.get_logger().info(self.session.whole_rule_text())
            if self.active:
                self._find_enable_type()
                self.subscribe()
                if self._enable_problem:
                    self.get_logger().warning(self._enable_problem)
        elif isinstance(candidate, Session) and self.session is not None:
            self._swap(candidate)
        elif self.session is None and self._starts_itself:
            self.start()

    def _swap(self, session: Session) -> None:
        """Replace the model, between two messages."""
        if self.session is not None and self.active:
            self.intake.waiting(all_of_them=True)
            session.go_on_from(self.session)
        taken_over = {topic for topic in session.types if topic == session.enable_topic or session.sampler.kept(topic)}
        self.snapshots.clear(self.session, taken_over - {session.sampler.clock})
        self.intake.session = session
        self.outputs.prepare(session)
        if self.active:
            self._find_enable_type()
            self.subscribe()
        name = Path(self.settings["model"]).name
        self.get_logger().info(f"model swapped: {name}: {session.model}; {session.whole_rule_text()}")
        self._event_log.begin(session, time.monotonic())

    # --- lifecycle ---

    @property
    def state_name(self) -> str:
        """The lifecycle state: unconfigured, inactive, active, finalized, or the transition that is under way."""
        return str(self._state_machine.current_state[1])

    @property
    def _idle(self) -> str:
        """What is said while it is not active."""
        return f"{self.state_name}: {self.reason or 'no verdicts are given'}"

    def start(self) -> None:
        """Configure and activate; if that fails the reason is logged and published on /diagnostics."""
        self._starts_itself = True
        if isinstance(self.executor, MultiThreadedExecutor):
            out_of_turn = "a MultiThreadedExecutor takes topics out of turn, so samples get other controls"
            self.get_logger().warning(f"{out_of_turn}; add the node to an EventsExecutor")
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self._starts_itself = self.trigger_activate() != TransitionCallbackReturn.SUCCESS

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        """Refuse what the state does not allow; rclpy itself raises, which would end the process."""
        try:
            return self._change_state(request, response)
        except RuntimeError:  # RCLError, which rclpy does not export
            number = request.transition.id
            asked = request.transition.label or _TRANSITIONS.get(number, str(number))
            state = self.state_name
            there = ", ".join(transition[1] for transition in self._state_machine.available_transitions)
            self.get_logger().error(f"no transition {asked} from {state}; there are {there or 'none'}")
            response.success = False
            return response

    @_failures_noted
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load and check the model, and offer the outputs."""
        path, fixed = self.settings["model"], True
        try:
            self.settings.requested_qos()
            self.settings.topic_prefix()
            fixed = False
            self.intake.session = session = self._make_session(self.settings)
            fixed = True
            self.snapshots.open()
        except Exception as error:
            self.intake.session = None
            self.reason = str(error) if isinstance(error, UncertainLTIError) else f"unexpected: {error!r}"
            then = "; start the node again with another" if fixed else ""
            if self._starts_itself and not fixed and not self.settings["required"]:
                then = "; the node starts as soon as its parameters are set right"
            self.get_logger().error(f"not configured: {self.reason}{then}")
            self.report()
            return TransitionCallbackReturn.FAILURE
        self.reason = ""
        self.outputs.open(self.settings["heartbeat"])
        self.outputs.prepare(session)
        self.get_logger().info(f"configured with {Path(path).name}: {session.model}")
        if session.model.sampling.dt_median is None:
            self.get_logger().info("the model has no median step, so nothing is predicted")
        return super().on_configure(state)

    @_failures_noted
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start with no sample and no verdict, and subscribe."""
        assert self.session is not None
        result = super().on_activate(state)
        self.session.restart(time.monotonic())
        self._look_at_clock()
        self.subscribe()
        self._event_log.begin(self.session, time.monotonic())
        resolved = {topic: self.resolve_topic_name(self.settings.there(topic)) for topic in self.session.types}
        topics = [topic if topic == name else f"{topic} (as {name})" for topic, name in resolved.items()]
        self.get_logger().info(f"active: listening to {shortlist(topics)}")
        self.intake.active = True
        self.outputs.poll()
        self._beat()
        return result

    @_failures_noted
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; no heartbeat is published from now on."""
        assert self.session is not None
        self._unsubscribe()
        self.session.reset()
        self._event_log.turned(self.session, (), time.monotonic(), ", as the node is no longer active")
        self.outputs.sender.send_reason("inactive: no verdicts are given")
        self.get_logger().info("no longer active: no verdicts are given")
        return super().on_deactivate(state)

    @_failures_noted
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release all resources, the model among them."""
        result = super().on_cleanup(state)
        self._release()
        return result

    on_shutdown = on_cleanup

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release all resources; the node can be configured again."""
        self.reason = "a transition failed unexpectedly; see the log"
        self.get_logger().error(self.reason)
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _release(self) -> None:
        self._unsubscribe()
        self.snapshots.close(self.session)
        self.outputs.close()
        self.intake.session = None

    def finish(self) -> None:
        """Shut down properly, at the end of the process."""
        if self.state_name in ("unconfigured", "inactive", "active"):
            self.trigger_shutdown()
        self.reason = ""
        self.report()
        self._diagnostics.publisher.wait_for_all_acked(Duration(seconds=_LAST_WORDS))

    # --- messages ---

    def subscribe(self) -> None:
        """Subscribe to exactly the topics needed; existing subscriptions to them are kept.

        The middleware takes no other type before it has let go of the former subscription; the next look does that.
        """
        assert self.session is not None
        types = {topic: full_name(name) for topic, name in self.session.types.items()}
        former = [topic for topic, subscription in self.inputs.items() if subscription.type_name != types.get(topic)]
        for topic in former:
            self.inputs.pop(topic).destroy()
            self._looked = -math.inf
        requested = self.settings.requested_qos()
        for topic in [topic for topic in types if topic not in (*self.inputs, *former)]:
            take = partial(self.intake.message, topic)
            self.inputs[topic] = MatchedSubscription(self, self.settings.there(topic), types[topic], take, requested)

    def _unsubscribe(self) -> None:
        self.intake.waiting(all_of_them=True)
        self.intake.active = False
        self.outputs.sender.changed()
        for subscription in self.inputs.values():
            subscription.destroy()
        self.inputs.clear()

    def _beat(self) -> None:
        assert self.session is not None
        self.outputs.sender.send_alarm(self.session.alarm, time.monotonic())

    # --- heartbeat, graph, diagnostics ---

    def tick(self) -> None:
        """Run the periodic tasks: heartbeat, graph, diagnostics, snapshots and log."""
        self._look_at_clock()
        tasks = (
            self._keep_beating, self._keep_reason, self._look_around, self._keep_reporting,
            lambda: self.snapshots.write_due(self.session, time.monotonic()), self._log_events,
        )  # fmt: skip
        for task in tasks:
            try:
                task()
            except Exception as error:
                self.note_failure("between messages", error)

    def _on_poll(self) -> None:
        for subscription in self.inputs.values():
            subscription.poll()
        self.outputs.poll()
        self.intake.waiting()
        if any(s.look_soon for s in self.inputs.values()):
            self._look_around()

    def _look_at_clock(self) -> None:
        """Take arrivals from /clock while that is in use."""
        if (active := self.clock.ros_time_is_active) and self._simulated is None:
            self._simulated = SimulatedTime(self)
        self.intake.clock = self._simulated if active else None

    def _keep_beating(self) -> None:
        if self.active and time.monotonic() - self.outputs.sender.alarm_sent >= self.settings["heartbeat"] / 2:
            self._beat()

    def _look_around(self) -> None:
        now = time.monotonic()
        if now - self._looked < _LOOK and not any(s.look_soon for s in self.inputs.values()):
            return
        self._looked = now
        for subscription in self.inputs.values():
            subscription.look()
        if self.session is not None:
            self.session.know_rivals(topic for topic, s in self.inputs.items() if s.takes_turns())
        self.outputs.look()
        self._twin, self._clocks = self.count_publishers(f"~/{VIOLATION.name}") > 1, self.count_publishers(CLOCK)
        self._find_enable_type()
        if self.active:
            self.subscribe()

    def _find_enable_type(self) -> None:
        session = self.session
        self._enable_problem = ""
        if session is None or not self.active or not session.enable_topic:
            return
        topic = session.enable_topic
        publishers_tell = not (session.rule.enable_type or topic in session.model.signals.topics)
        there = self.resolve_topic_name(self.settings.there(topic))
        found = [info.topic_type for info in self.get_publishers_info_by_topic(there)]
        if not found:
            if session.heard(topic) is None:
                self._enable_problem = f"nobody publishes {there}, which parameter enable names"
        elif publishers_tell and session.enable_type not in found:
            try:
                session.found_enable_type(found[0])
            except UncertainLTIError as error:
                self._enable_problem = f"parameter enable: {error}"
                return
        if why := session.why_no_condition():
            self._enable_problem = f"parameter enable: {why}"

    def _keep_reason(self) -> None:
        """Publish ~/reason also while nobody subscribes, for whoever will, and where nothing comes any more."""
        if self.active and self.session is not None:
            self.outputs.sender.send_reason(self.session.reason(time.monotonic(), self._timeout))

    def _keep_reporting(self) -> None:
        now = time.monotonic()
        if now - self._reported < self.settings["diagnostics_period"]:
            return
        if self.session is not None and self.active and not self._diagnostics.publisher.get_subscription_count():
            self._reported = now
            self.session.pass_over()
            self._mark_reported()
        else:
            self.report()

    def _log_events(self) -> None:
        now = time.monotonic()
        if self.session is None or not self.active or now - self._noted < _NOTE:
            return
        self._noted = now
        problems = [problem for subscription in self.inputs.values() for problem in subscription.problems]
        problems += self._lasting_problems()
        publishers = {topic: subscription.publishers for topic, subscription in self.inputs.items()}
        self._event_log.look(self.session, now, self._timeout, publishers, problems)

    def _log(self, level: int, line: str) -> None:
        if level == WARN:
            self.get_logger().warning(line)
        else:  # rclpy lets a line of code log at one level only
            self.get_logger().info(line)

    def _lasting_problems(self) -> list[str]:
        """Problems that last and concern no topic of the model."""
        rivals = self.session.reasons.rivals if self.session is not None else ""
        problems = [problem for problem in (self._enable_problem, rivals) if problem]
        if self._twin:
            topic = f"{self.get_fully_qualified_name()}/{VIOLATION.name}"
            problems.append(f"another node publishes {topic} too; give one of them another name, -r __node:=NAME")
        problems += self.outputs.sender.problems
        if self.intake.clock is not None and not self.intake.clock():
            problems.append(f"use_sim_time is true, and no time has come on {CLOCK}")
        if self.intake.clock is not None and self._clocks > 1:
            problems.append(f"{self._clocks} publishers send {CLOCK}, and time jumps between them; stop all but one")
        return problems + self.snapshots.problems

    def _problems(self) -> list[str]:
        """Why messages are missing, other than silence, and what went wrong in the node since the last report."""
        problems = self._diagnostics.problems(self.inputs) + self._lasting_problems()
        return problems + self.failures.problems()

    def report(self) -> None:
        """Publish diagnostics."""
        now = self._reported = time.monotonic()
        if self.session is not None and self.active:
            reports = self.session.report(now, self._timeout, self._problems())
            extra = input_values(self.inputs) | self.snapshots.values
            extra |= {"unexpected errors": str(self.failures.count), "held back": str(self.outputs.sender.held_back)}
            reports[0] = replace(reports[0], values={**reports[0].values, **extra})
        else:
            level = ERROR if self.reason else STALE
            reports = [Report(level, "monitor", self._idle, {"unexpected errors": str(self.failures.count)})]
            if self.session is not None:
                reports += [Report(STALE, name, self._idle, {}) for name in self.session.model.state_names]
        self._mark_reported()
        self._diagnostics.publish(reports, self.clock.now().to_msg(), self.settings["model"])

    def _mark_reported(self) -> None:
        self.failures.reported()
        self._diagnostics.reported(self.inputs)

    # --- services ---

    def _serve(
        self, serve: Callable[[], tuple[bool, str]], _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Answer a call; a refusal and an unexpected error are reported in the answer."""
        try:
            response.success, response.message = serve()
        except UncertainLTIError as error:
            response.success, response.message = False, str(error)
        except Exception as error:
            self.note_failure("in a service", error)
            response.success, response.message = False, f"unexpected: {error!r}"
        return response

    def _on_reset(self) -> tuple[bool, str]:
        """End a latched alarm, and let the alarm look at verdicts from now on only."""
        if self.session is None or not self.active:
            raise ModelError("the node is not active, so there is no alarm to reset")
        done = "the alarm is reset" if self.session.alarm else "there was no alarm; its window is empty now"
        self.session.reset()
        self._event_log.turned(self.session, (), time.monotonic(), ", by ~/reset")
        self._beat()
        return True, done

    def _on_reload(self) -> tuple[bool, str]:
        """Read the model file once more."""
        if self.session is None:
            raise ModelError("the node is not configured; configure it, which reads the model file")
        path = self.settings["model"]
        self._swap(self._make_session(self.settings))
        return True, f"{Path(path).name}: {self.session.model}"

    def _on_status(self) -> tuple[bool, str]:
        """Whether verdicts are given, and counters as JSON."""
        session, active, now = self.session, self.active, time.monotonic()
        return active, json.dumps(
            {
                "state": self.state_name,
                "reason": self.reason,
                "model": self.settings["model"],
                "now_ns": self.intake.clock() if self.intake.clock else self.clock.now().nanoseconds,
                "use_sim_time": self.get_parameter("use_sim_time").value,
                "received": {s.topic: s.received for s in self.inputs.values()},
                "lost": {s.topic: s.lost for s in self.inputs.values()},
                "listeners": {name: output.listeners for name, output in self.outputs.publishers.items()},
                "verdicts": session.verdicts if session else 0,
                "violations": dict(zip(session.model.state_names, session.violations, strict=True)) if session else {},
                "alarm": session.alarm if session else False,
                "why": session.reason(now, self._timeout) if session and active else self._idle,
                "looks_like": like.words if session and (like := session.explainer.likeness()) else "",
                "latched": session.latched if session else False,
                "armed": session.arming.on if session else None,
                "held_back": self.outputs.sender.held_back,
                "counters": dict(session.sampler.counters) if session else {},
                "unreadable": dict(session.unreadable) if session else {},
                "future": dict(session.future) if session else {},
                "decoded": session.decoded if session else {},
                "unexpected_errors": self.failures.count,
                "snapshot": self.snapshots.values.get("last snapshot", ""),
                "problems": self._problems(),
            }
        )


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal ends it."""
    return run_node(NAME, _SUMMARY, PARAMETERS, _run, args)


def _run(args: list[str]) -> int:
    spare_the_middleware()
    with living(EnvelopeMonitorNode, args) as life:
        node = life.node
        assert isinstance(node, EnvelopeMonitorNode)
        node.get_logger().info(f"runs on the {life.executor_name}")
        if node.get_parameter("autostart").value:
            node.start()
            if not node.active and node.settings["required"]:
                node.get_logger().error("ends, as parameter required is true")
                node.report()
                return BAD_USAGE
        gc.collect()
        gc.freeze()  # what is here stays: the collector need not look at it again and again
        life.spin(node.note_failure)
        node.finish()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
