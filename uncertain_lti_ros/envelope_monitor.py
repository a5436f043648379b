"""`envelope_monitor`: the lifecycle node that watches live topics; parameters, QoS, clocks and messages only."""

from __future__ import annotations

import json
import time
from array import array
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from uncertain_lti.errors import ModelError, UncertainLTIError
from uncertain_lti.model import UncertainLTI
from uncertain_lti.monitor import Verdict
from uncertain_lti_ros.messages import live_fields, message_class, stamp_ns
from uncertain_lti_ros.process import living
from uncertain_lti_ros.subscriptions import DEPTH, DURABILITY, RELIABILITY, MatchedSubscription, Wish
from uncertain_lti_ros.watch import ERROR, STALE, Report, Rule, Watch, topic_types

NAME = "envelope_monitor"
VECTORS = ("flags", "lower", "upper", "state", "utilisation", "predicted_lower", "predicted_upper")
"""Topics below the node's name that carry one number per state as sensor_msgs/JointState."""
_LOOK = 1.0  # s between two looks at the graph; events of the middleware bring it forward
_OUTPUT_DEPTH = 1000
_NAN = float("nan")

_RULE = ("violations", "window", "margin")


class EnvelopeMonitorNode(LifecycleNode):
    """Managed node around `Watch`; the page on the live node describes its topics, services and parameters."""

    def __init__(self) -> None:
        super().__init__(NAME)
        self._declare()
        self.watch: Watch | None = None
        self.active = False
        self._reason = ""  # why the last configure failed
        self._starts_itself = False  # autostart was asked for and has not succeeded yet
        self._inputs: dict[str, MatchedSubscription] = {}
        self._outputs: dict[str, Any] = {}
        self._candidate: Watch | Rule | None = None  # accepted, not yet in place
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)  # a paused or looping simulation must not stop these
        self._published = self._looked = self._reported = time.monotonic()
        self._joint_state = JointState()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(Trigger, "~/status", self._on_status)
        self.add_on_set_parameters_callback(self._on_set)
        self.add_post_set_parameters_callback(self._on_have_set)
        tick = min(0.1, self._real("heartbeat") / 4, self._real("diagnostics_period") / 2)
        self.create_timer(tick, self._on_tick, clock=self._steady)
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state

    # --- parameters ---

    def _declare(self) -> None:
        def say(text: str, read_only: bool = False, **limits: Any) -> ParameterDescriptor:
            return ParameterDescriptor(description=text, read_only=read_only, **limits)

        def whole(low: int, high: int) -> dict[str, Any]:
            return {"integer_range": [IntegerRange(from_value=low, to_value=high, step=0)]}

        def real(low: float, high: float) -> dict[str, Any]:
            return {"floating_point_range": [FloatingPointRange(from_value=low, to_value=high, step=0.0)]}

        self.declare_parameter(
            "model", "", say("Path of the model file. Setting it while running swaps the model, or is refused.")
        )
        self.declare_parameter("autostart", True, say("Configure and activate without being asked.", True))
        self.declare_parameter(
            "violations", 0,
            say("Alarm while this many of the last `window` verdicts are violations; 0: as the model says. "
                "Setting it starts the alarm anew.", **whole(0, 10**6)),
        )  # fmt: skip
        self.declare_parameter(
            "window", 0,
            say("Verdicts that the alarm looks at; 0: as the model says. Setting it starts the alarm anew.",
                **whole(0, 10**6)),
        )  # fmt: skip
        self.declare_parameter(
            "margin", 0.0,
            say("Factor on the half-widths of the bounds that are judged; 0: as the model says. "
                "Setting it starts the alarm anew.", **real(0.0, 1e6)),
        )  # fmt: skip
        self.declare_parameter(
            "heartbeat", 1.0,
            say("~/violation is published at least this often, s of wall time; also the deadline it offers.", True,
                **real(0.05, 3600.0)),
        )  # fmt: skip
        self.declare_parameter(
            "state_timeout",
            1.0,
            say("Without a verdict for this long, s of wall time, states are reported STALE.", **real(0.01, 86400.0)),
        )
        self.declare_parameter(
            "diagnostics_period",
            1.0,
            say("Time between two messages on /diagnostics, s of wall time.", True, **real(0.05, 3600.0)),
        )
        self.declare_parameter(
            "hardware_id", "", say("hardware_id in /diagnostics; empty: the name of this node.", True)
        )
        self.declare_parameter(
            "qos.depth", DEPTH,
            say("Messages kept per subscription until they are taken.", True, **whole(1, 10**6)),
        )  # fmt: skip
        self.declare_parameter(
            "qos.reliability", "match",
            say(f"Of the subscriptions: match (what publishers offer), {' or '.join(RELIABILITY)}.", True),
        )  # fmt: skip
        self.declare_parameter(
            "qos.durability", "match",
            say(f"Of the subscriptions: match (what publishers offer), {' or '.join(DURABILITY)}.", True),
        )  # fmt: skip

    def _real(self, name: str) -> float:
        return float(self.get_parameter(name).value)

    def _rule(self, changes: dict[str, Any]) -> Rule:
        return Rule(**{name: changes.get(name, self.get_parameter(name).value) for name in _RULE})

    def _wish(self) -> Wish:
        chosen: dict[str, Any] = {}
        for name, known in (("reliability", RELIABILITY), ("durability", DURABILITY)):
            text = self.get_parameter(f"qos.{name}").value
            if text != "match" and text not in known:
                raise ModelError(f"parameter qos.{name} is {text!r}; choose match, {' or '.join(known)}")
            chosen[name] = known.get(text)
        return Wish(self.get_parameter("qos.depth").value, **chosen)

    def _make_watch(self, path: str, rule: Rule) -> Watch:
        if not path:
            raise ModelError("parameter 'model' is empty; give the path of a model file")
        model = UncertainLTI.load(path)
        return Watch(model, rule, topic_types(model, path, live_fields), time.monotonic())

    def _on_set(self, parameters: Iterable[Parameter]) -> SetParametersResult:
        """Make what the new values ask for, or say why not; it takes its place in `_on_have_set`."""
        changes = {p.name: p.value for p in parameters if p.name in ("model", *_RULE)}
        self._candidate = None
        try:
            if "model" in changes:
                self._candidate = self._make_watch(changes["model"], self._rule(changes))
            elif changes and self.watch is not None:
                self._candidate = self._rule(changes)
                self._candidate.monitor(self.watch.model)
        except UncertainLTIError as error:
            self._candidate = None
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_have_set(self, _: Sequence[Parameter]) -> None:
        candidate, self._candidate = self._candidate, None
        if isinstance(candidate, Rule) and self.watch is not None:
            self.watch.follow(candidate)
        elif isinstance(candidate, Watch):
            if self.watch is not None:
                self.watch = candidate
                if self.active:
                    self._subscribe()
                self.get_logger().info(f"model swapped: {candidate.model}")
            elif self._starts_itself:
                self.start()

    # --- lifecycle ---

    def start(self) -> None:
        """Configure and activate; where that fails the reason is logged and stands in /diagnostics."""
        self._starts_itself = True
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self._starts_itself = self.trigger_activate() != TransitionCallbackReturn.SUCCESS

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        """Refuse what the state does not allow; rclpy on its own raises, which would end the process."""
        try:
            return self._change_state(request, response)
        except RuntimeError:  # RCLError, which rclpy does not export
            asked = request.transition.label or request.transition.id
            state = self._state_machine.current_state[1]
            there = ", ".join(transition[1] for transition in self._state_machine.available_transitions)
            self.get_logger().error(f"no transition {asked} from {state}; there are {there or 'none'}")
            response.success = False
            return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load and check the model, and offer the outputs."""
        path = str(self.get_parameter("model").value)
        try:
            self._wish()
            self.watch = self._make_watch(path, self._rule({}))
        except UncertainLTIError as error:
            self._reason = str(error)
            self.get_logger().error(f"not configured: {self._reason}")
            self._report()
            return TransitionCallbackReturn.FAILURE
        self._reason = ""
        qos = QoSProfile(depth=_OUTPUT_DEPTH)
        for name in VECTORS:
            self._outputs[name] = self.create_lifecycle_publisher(JointState, f"~/{name}", qos)
        beat = QoSProfile(depth=_OUTPUT_DEPTH, deadline=Duration(seconds=self._real("heartbeat")))
        self._outputs["violation"] = self.create_lifecycle_publisher(Bool, "~/violation", beat)
        self.get_logger().info(f"configured with {Path(path).name}: {self.watch.model}")
        if self.watch.model.sampling.dt_median is None:
            self.get_logger().info("the model has no median step, so nothing is predicted")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start with no sample and no verdict, and subscribe."""
        assert self.watch is not None
        result = super().on_activate(state)
        self.watch.restart(time.monotonic())
        self._subscribe()
        self.active = True
        self._beat()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; no heartbeat comes from now on."""
        self._unsubscribe()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the model."""
        result = super().on_cleanup(state)
        self._put_away()
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Put everything away."""
        result = super().on_shutdown(state)
        self._put_away()
        return result

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Put everything away; the node can be configured again."""
        self._reason = "a transition failed unexpectedly; see the log"
        self.get_logger().error(self._reason)
        self._put_away()
        return TransitionCallbackReturn.SUCCESS

    def _put_away(self) -> None:
        self._unsubscribe()
        for publisher in self._outputs.values():
            self.destroy_lifecycle_publisher(publisher)
        self._outputs.clear()
        self.watch = None

    def finish(self) -> None:
        """The orderly end of the process."""
        if self._state_machine.current_state[1] in ("unconfigured", "inactive", "active"):
            self.trigger_shutdown()
        self._reason = ""
        self._report()

    # --- messages ---

    def _subscribe(self) -> None:
        """Listen to exactly the topics of the model; what is listened to already goes on undisturbed."""
        assert self.watch is not None
        for topic in list(self._inputs):
            if self._inputs[topic].type_name != self.watch.types.get(topic):
                self._inputs.pop(topic).destroy()
        for topic, type_name in self.watch.types.items():
            if topic not in self._inputs:
                self._inputs[topic] = MatchedSubscription(
                    self, topic, type_name, message_class(type_name), partial(self._on_message, topic), self._wish()
                )

    def _unsubscribe(self) -> None:
        self.active = False
        for subscription in self._inputs.values():
            subscription.destroy()
        self._inputs.clear()

    def _on_message(self, topic: str, message: Any) -> None:
        arrival = self.get_clock().now().nanoseconds
        if not self.active or self.watch is None:
            return
        watch = self.watch
        alarm = watch.monitor.alarm
        verdicts, opened = watch.take(topic, arrival, stamp_ns(message), message, time.monotonic())
        for verdict in verdicts:
            self._publish(verdict)
        if any(verdict.judged for verdict in verdicts) or watch.monitor.alarm != alarm:
            self._beat()
        if opened and self._wanted("predicted_lower", "predicted_upper"):
            if (prediction := watch.predict()) is not None:
                t_ns, lower, upper = prediction
                self._send("predicted_lower", t_ns, lower)
                self._send("predicted_upper", t_ns, upper)

    def _publish(self, verdict: Verdict) -> None:
        if self._wanted("flags"):
            outside = float(verdict.outside_domain) if verdict.judged else _NAN
            self._joint_state.velocity = array("d", [outside] * len(verdict.flags))
            self._send("flags", verdict.t_ns, verdict.flags)
            self._joint_state.velocity = array("d")
        if verdict.judged:
            for name in ("lower", "upper", "state", "utilisation"):
                if self._wanted(name):
                    self._send(name, verdict.t_ns, getattr(verdict, name))

    def _wanted(self, *names: str) -> bool:
        return any(self._outputs[name].get_subscription_count() for name in names)

    def _send(self, name: str, t_ns: int, values: Any) -> None:
        assert self.watch is not None
        message = self._joint_state
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 1_000_000_000)
        message.name = self.watch.model.state_names
        message.position = array("d", values.tobytes())
        self._outputs[name].publish(message)

    def _beat(self) -> None:
        assert self.watch is not None
        self._published = time.monotonic()
        self._outputs["violation"].publish(Bool(data=self.watch.monitor.alarm))

    # --- heartbeat, graph, diagnostics ---

    def _on_tick(self) -> None:
        now = time.monotonic()
        if self.active and now - self._published >= self._real("heartbeat") / 2:
            self._beat()
        if now - self._looked >= _LOOK or any(s.look_soon for s in self._inputs.values()):
            self._looked = now
            for subscription in self._inputs.values():
                subscription.look()
        if now - self._reported >= self._real("diagnostics_period"):
            self._report()

    def _problems(self) -> list[str]:
        """What keeps messages from coming, beside silence."""
        problems = []
        for subscription in self._inputs.values():
            problems += subscription.problems
            if subscription.lost:
                problems.append(f"{subscription.topic}: {subscription.lost} messages lost on the way")
        return problems

    def _report(self) -> None:
        now = self._reported = time.monotonic()
        if self.watch is not None and self.active:
            reports = self.watch.report(now, self._real("state_timeout"), self._problems())
            extra = {}
            for topic, subscription in self._inputs.items():
                extra |= {
                    f"publishers {topic}": str(subscription.publishers),
                    f"lost {topic}": str(subscription.lost),
                    f"qos {topic}": f"{subscription.qos.reliability.name} {subscription.qos.durability.name}".lower(),
                }
            reports[0] = Report(reports[0].level, reports[0].name, reports[0].message, {**reports[0].values, **extra})
        else:
            state = self._state_machine.current_state[1]
            message = f"{state}: {self._reason}" if self._reason else f"{state}: no verdicts are given"
            level = ERROR if self._reason else STALE
            reports = [Report(level, "monitor", message, {})]
            if self.watch is not None:
                reports += [Report(STALE, name, message, {}) for name in self.watch.model.state_names]
        full_name = self.get_fully_qualified_name().lstrip("/")
        hardware = str(self.get_parameter("hardware_id").value) or self.get_name()
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        path = str(self.get_parameter("model").value)
        for report in reports:
            values = {"model": path, **report.values} if report is reports[0] else report.values
            message.status.append(
                DiagnosticStatus(
                    level=bytes([report.level]),
                    name=f"{full_name}: {report.name}",
                    message=report.message,
                    hardware_id=hardware,
                    values=[KeyValue(key=key, value=value) for key, value in values.items()],
                )
            )
        self._diagnostics.publish(message)

    def _on_status(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Counters as JSON; success says whether verdicts are given."""
        watch = self.watch
        response.success = self.active
        response.message = json.dumps(
            {
                "state": self._state_machine.current_state[1],
                "reason": self._reason,
                "model": self.get_parameter("model").value,
                "now_ns": self.get_clock().now().nanoseconds,
                "use_sim_time": self.get_parameter("use_sim_time").value,
                "received": {s.topic: s.received for s in self._inputs.values()},
                "lost": {s.topic: s.lost for s in self._inputs.values()},
                "verdicts": watch.verdicts if watch else 0,
                "violations": dict(zip(watch.model.state_names, watch.violations, strict=True)) if watch else {},
                "alarm": watch.monitor.alarm if watch else False,
                "counters": dict(watch.sampler.counters) if watch else {},
                "problems": self._problems(),
            }
        )
        return response


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal ends it."""
    with living(EnvelopeMonitorNode, args) as life:
        node = life.node
        assert isinstance(node, EnvelopeMonitorNode)
        node.get_logger().info(f"runs on the {life.executor_name}")
        if node.get_parameter("autostart").value:
            node.start()
        life.spin()
        node.finish()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
